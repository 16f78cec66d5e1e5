"""Springs with what real ones have and the catalogue states otherwise, or not at all: nothing may be surely wrong.

    python benchmarks/blind/odd_springs.py --seed 1 --count 16 --out runs/odd

A mass on a spring under a few waves of force, by semi-implicit steps of 20 kHz in which dry friction takes off what
speed there is, logged at 100 Hz with noise, in gusts. Each kind says what may stand as found for sure: the effect that
it is, or one that is the same law in these data. What else is found for sure counts as surely wrong; leads, ties and
`unexplained` do not.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from study import Array, Json, answers, in_turn, judged, options, save, table, written

STEP, INNER = 0.01, 200
GAIN, STIFFNESS, DAMPING = 1.2, 5.0, 0.4
_STOP = "force = c1 max(q - k1, 0)"


@dataclass
class State:
    """What moves: position and speed, time in the run, and what a kind remembers."""

    q: float = 0.0
    v: float = 0.0
    t: float = 0.0
    own: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Kind:
    acts: Callable[[float, State], float] = lambda u, s: u  # input that acts, from the command and the state
    pulls: Callable[[float, State], float] = lambda u, s: 0.0  # what accelerates it further
    dry: Callable[[State], float] = lambda s: 0.0  # size of the dry friction
    may: tuple[str, ...] = ()  # effects that may stand as found for sure
    logs: Callable[[Array], Array] = lambda x: x  # what is logged of a position or a speed


def _slew(limit: float) -> Callable[[float, State], float]:
    def acts(u: float, s: State) -> float:
        at, most = s.own.get("u", 0.0), limit * STEP / INNER
        s.own["u"] = at + min(max(u - at, -most), most)
        return s.own["u"]

    return acts


def _servo(hertz: float, ratio: float) -> Callable[[float, State], float]:
    w, h = 2.0 * math.pi * hertz, STEP / INNER

    def acts(u: float, s: State) -> float:
        at, rate = s.own.get("m", 0.0), s.own.get("rate", 0.0)
        s.own["rate"] = rate + h * (w * w * (u - at) - 2.0 * ratio * w * rate)
        s.own["m"] = at + h * s.own["rate"]
        return s.own["m"]

    return acts


def _hidden(stiffness: float, damping: float) -> Callable[[float, State], float]:
    """A second mass of a quarter on a spring of its own, which nobody sees."""

    def pulls(u: float, s: State) -> float:
        h, p, w = STEP / INNER, s.own.get("p", 0.0), s.own.get("w", 0.0)
        force = stiffness * (s.q - p) + damping * (s.v - w)
        s.own["w"] = w + h * force
        s.own["p"] = p + h * s.own["w"]
        return -0.25 * force

    return pulls


def kinds(rng: np.random.Generator) -> dict[str, Kind]:
    """Kinds of machines, their sizes drawn anew."""

    def between(*ends: tuple[float, float]) -> list[float]:
        return [float(rng.uniform(*of)) for of in ends]

    size, stop, slope, weaker = between((0.25, 0.6), (0.25, 0.35), (30.0, 80.0), (0.6, 0.8))
    rate, turn, fast, part = between((4.0, 7.0), (12.0, 25.0), (0.05, 0.1), (0.3, 0.6))
    back, ahead, floor, ceiling = between((0.1, 0.3), (0.3, 0.6), (1.0, 1.4), (1.5, 2.0))
    hertz, ratio = between((1.0, 6.0), (0.1, 0.8))
    dry = ("coulomb_friction", "stribeck_friction")
    return {
        "nothing": Kind(),
        "sticks": Kind(dry=lambda s: 3.0 * size, may=dry),
        "stribeck": Kind(dry=lambda s: size * (1.0 + 0.6 * math.exp(-((s.v / fast) ** 2))), may=dry),
        "warms": Kind(dry=lambda s: size * (0.4 + 0.6 * math.exp(-s.t / 10.0)), may=dry),
        "slew": Kind(acts=_slew(rate), may=("actuator_rate_limit",)),
        "levels": Kind(acts=lambda u, s: round(u / 0.25) * 0.25),
        "stops": Kind(
            pulls=lambda u, s: -slope * (max(s.q - stop, 0.0) + min(s.q + stop, 0.0)),
            may=(_STOP, _STOP.replace("max", "min")),
        ),
        "one stop": Kind(pulls=lambda u, s: -slope * max(s.q - stop, 0.0), may=(_STOP,)),
        "one-sided motor": Kind(acts=lambda u, s: u if u > 0 else weaker * u, may=("asymmetric_gain",)),
        "loses its load": Kind(pulls=lambda u, s: 0.0 if s.t < 15.0 else 0.5 * (GAIN * u - STIFFNESS * s.q)),
        "vibrates": Kind(
            pulls=lambda u, s: 0.5 * math.sin(turn * s.t), may=("periodic_force", "sinusoidal_force")
        ),
        "hidden mass": Kind(pulls=_hidden(40.0, 0.2), may=("hidden_mass",)),
        "three": Kind(
            pulls=lambda u, s: 0.3 - 1.5 * s.v * abs(s.v),
            dry=lambda s: size,
            may=(*dry, "constant_force", "quadratic_damping", "asymmetric_friction"),
        ),
        "coarse encoder": Kind(logs=lambda x: np.round(x / 0.01) * 0.01),
        "pull in the past": Kind(pulls=lambda u, s: _late(u, s, 0.25, part)),
        "wall of magnets": Kind(pulls=lambda u, s: 0.03 / (0.9 - min(s.q, 0.8)) ** 2),
        "off-centre gap": Kind(acts=lambda u, s: u - min(max(u, -back), ahead), may=("asymmetric_deadband",)),
        "cut by sign": Kind(acts=lambda u, s: min(max(u, -floor), ceiling), may=("asymmetric_saturation",)),
        "servo": Kind(acts=_servo(hertz, ratio), may=("actuator_resonance",)),
    }


def _late(u: float, s: State, tau: float, part: float) -> float:
    """A part of the force acts late: its low-pass, which a magnet's eddy currents give."""
    at = s.own.get("m", 0.0)
    s.own["m"] = at + STEP / INNER / tau * (u - at)
    return part * GAIN * (s.own["m"] - u)


def run(kind: Kind, rng: np.random.Generator, seconds: float = 30.0) -> Array:
    """One run: time, position, speed, command (n, 4)."""
    turn, phase, high = rng.uniform(0.8, 7.0, 5), rng.uniform(0.0, 6.3, 5), rng.uniform(0.4, 1.0, 5)
    count, h = round(seconds / STEP), STEP / INNER
    s, rows, gust = State(), np.empty((count, 4)), 0.0
    for i in range(count):
        u = float(high @ np.sin(turn * i * STEP + phase))
        rows[i] = i * STEP, s.q, s.v, u
        gust += -gust * STEP / 0.05 + 0.1 * float(rng.normal()) * math.sqrt(2.0 * STEP / 0.05)
        for _ in range(INNER):
            acting = kind.acts(u, s)
            pull = GAIN * acting - STIFFNESS * s.q - DAMPING * s.v + kind.pulls(acting, s) + gust
            free = s.v + h * pull
            s.v = math.copysign(max(abs(free) - h * kind.dry(s), 0.0), free)
            s.q += h * s.v
            s.t += h
    rows[:, 1:3] = kind.logs(rows[:, 1:3] + 0.003 * rng.normal(size=(count, 2)))
    return rows


def write(name: str, seed: int, folder: Path, runs: int = 3) -> Kind:
    rng = np.random.default_rng([seed, list(kinds(np.random.default_rng(0))).index(name)])
    kind = kinds(rng)[name]
    for k in range(runs):
        rows = run(kind, rng)
        rows[:, 0] += 100.0 * k
        save(folder / f"run_{k}.csv", ("t", "q", "q_dot", "force"), [rows])
    return kind


def case(name: str, seed: int) -> Json:
    kind, found, answer = written(lambda folder: write(name, seed, folder), "mass_spring_damper")
    recording = [f.sentence for f in found.recorded.faults]
    return {**judged(answer, {name: {} for name in kind.may}), "recording": recording}


def main() -> None:
    names = list(kinds(np.random.default_rng(0)))
    args = options(__doc__, "seed", "out", first=0, count=len(names)).parse_args()
    table(answers(args.out, in_turn(args, names, case)))


if __name__ == "__main__":
    main()
