"""Springs and multirotors that carry a mass which is not in the log: is it named alone, and do its sizes hold?

    python benchmarks/blind/hidden_masses.py springs --first 0 --count 12
    python benchmarks/blind/hidden_masses.py loads --first 0 --count 4

Every fourth case carries none, and logs of every third begin in the middle of motion. Springs are integrated here by
Runge and Kutta's method at a millisecond; multirotors are those of `closed_loop.py` with a load on a cable.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from closed_loop import _machine
from loop_flight import PATHS, Flight, fly
from loop_machine import STEP, Array, Bodies, G, Machine
from small_machines import step
from study import Json, answers, diagnosed, judged, numbered, options, table

from nsde_torch.data.raw import RawRun

RUN_S, PAUSE_S = 30.0, 5.0


def drawn(rng: np.random.Generator, *ends: tuple[float, float]) -> list[float]:
    """Numbers between ends, even in their logarithms."""
    return [float(np.exp(rng.uniform(*np.log(of)))) for of in ends]


def spring(seed: int) -> tuple[str, list[RawRun], dict[str, dict[str, float]]]:
    """System, three runs and effects of a spring; of every other seed, of a loop that reads what is logged."""
    rng = np.random.default_rng([seed, 1])
    none, loop = seed % 4 == 3, bool(rng.integers(2))
    mass, own_hertz, rubs = drawn(rng, (0.03, 0.3), (0.4, 4.0), (0.02, 0.3))  # over the machine's, [Hz], 1
    heavy = 0.0 if none else mass
    gain, stiffness, damping = (float(rng.uniform(*ends)) for ends in ((0.6, 2.0), (1.0, 8.0), (0.1, 0.9)))
    dt = float(rng.choice([0.01, 0.02, 0.03]))
    sensors = np.exp(rng.uniform(np.log([0.0003, 0.002]), np.log([0.002, 0.01])))
    w, fine = 2.0 * np.pi * own_hertz, round(dt / STEP)

    def rates(x: Any, u: Array) -> list[Array]:
        pull = w * w * (x[2] - x[0]) + 2.0 * rubs * w * (x[3] - x[1])
        own = gain * u - stiffness * x[0] - damping * x[1] + heavy * pull
        return [x[1], own, x[3], -pull]

    begun = round(6.0 / dt) if seed % 3 == 1 else 0  # rows that are not logged
    n, runs = begun + round(RUN_S / dt), 3
    hertz, phase = rng.uniform(0.1, 2.5, (runs, 6)), rng.uniform(0.0, 2.0 * np.pi, (runs, 6))
    x, seen, inputs = list(np.zeros((4, runs))), np.empty((n, runs, 2)), np.empty((n, runs))
    for k in range(n):
        seen[k] = np.transpose(x[:2]) + sensors * rng.standard_normal((runs, 2))
        u = 0.5 * np.sin(2.0 * np.pi * hertz * k * dt + phase).sum(1)
        if loop:
            u = u - 1.5 * seen[k, :, 0] - 0.4 * seen[k, :, 1]
        inputs[k] = u
        for _ in range(fine):
            x = step(lambda x, u=u: rates(x, u), x, STEP)
    t = dt * np.arange(n)
    out = [RawRun(f"run_{r}", t + r * (RUN_S + PAUSE_S), seen[:, r], inputs[:, r, None]) for r in range(runs)]
    sizes = {"mass": mass, "frequency": own_hertz, "damping": rubs}
    return "mass_spring_damper", out, {} if none else {"hidden_mass": sizes}


class Loaded(Bodies):
    """Multirotors that carry a load on a cable, at any angle; the pull is held over a step of the integration."""

    mass, length, damping = 0.1, 1.0, 0.05

    def __init__(self, machines: list[Machine], *how: Any) -> None:
        super().__init__(machines, *how)
        self.way, self.turn = np.tile([0.0, 0.0, -1.0], (len(machines), 1)), np.zeros((len(machines), 3))

    def gust(self) -> Array:
        push = super().gust()
        own = self.rates(self.p, self.v, self.q, self.w, self.m, self.t, push)[1]
        # masses over the machine's: own + tension s and (0, 0, -g) - tension / mass s, at a distance that stays
        falls = np.array([0.0, 0.0, -G]) - own
        speed = np.square(self.turn).sum(1, keepdims=True)
        tension = (self.length * speed + (self.way * falls).sum(1, keepdims=True)) / (1.0 / self.mass + 1.0)
        rubs = 2.0 * self.damping * np.sqrt(G / self.length) * self.turn
        away = falls - tension * (1.0 / self.mass + 1.0) * self.way  # what the load gains on the machine
        self.turn = self.turn + self.step * (away / self.length - rubs)
        way = self.way + self.step * self.turn
        self.way = way / np.linalg.norm(way, axis=1, keepdims=True)
        self.turn -= (self.turn * self.way).sum(1, keepdims=True) * self.way
        push = push.copy()
        push[:, :3] += tension * self.way + self.mass * self.length * rubs
        return push


def load(seed: int) -> tuple[str, list[RawRun], dict[str, dict[str, float]]]:
    """System, four flights and effects of a multirotor under a controller that reads what is logged."""
    rng = np.random.default_rng([seed, 2])
    none = seed % 4 == 3
    Loaded.mass, Loaded.length, Loaded.damping = drawn(rng, (0.05, 0.3), (0.3, 2.5), (0.01, 0.1))
    machine = _machine("quadrotor" if rng.integers(2) else "hexacopter", rng)
    paths, own = rng.permutation(PATHS).tolist(), int(rng.integers(2**31))
    vigour, known = float(rng.uniform(0.9, 1.4)), tuple(float(v) for v in rng.uniform(0.9, 1.1, 4))
    how = 1.0, vigour, known
    flights = [Flight(machine, path, "a", 40.0, 60.0 * k, own + k, *how) for k, path in enumerate(paths)]
    flown = fly(flights, Bodies if none else Loaded)
    runs = [RawRun(f"run_{k}", run.t, run.x, run.u) for k, run in enumerate(flown)]
    sizes = {"mass": Loaded.mass, "length": Loaded.length, "damping": Loaded.damping}
    return machine.system, runs, {} if none else {"slung_load": sizes}


def case(make: Callable[[int], Any], _: int, seed: int) -> Json:
    """A machine of a seed, diagnosed."""
    system, runs, true = make(seed)
    return judged(diagnosed(runs, system)[1], true)


def main() -> None:
    parser = options(__doc__, seed=0, first=0, count=12, out=None)
    parser.add_argument("what", choices=("springs", "loads"))
    a = parser.parse_args()
    table(answers(a.out, numbered(a, partial(case, spring if a.what == "springs" else load), a.what)))


if __name__ == "__main__":
    main()
