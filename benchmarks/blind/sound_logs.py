"""Sound logs after the habits of laboratories: what does reading them say that is not so?

    python benchmarks/blind/sound_logs.py --seed 5 --out sound/
    python benchmarks/blind/sound_logs_run.py --seed 5 --logs sound/

writes three runs of each log (CSV). Each log has one excitation and one or two habits. Springs and carts are those of
`small_machines`, integrated here in plain Python; quadrotors are those of `loop_flight`. None of it shares code with
`nsde_torch`. Nothing is wrong with any log, and machines hold nothing that is not declared.
"""

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from closed_loop import _machine
from loop_flight import SENSORS, Flight, fly, four_times, measured
from small_machines import rate, small, step
from study import Array, columns, save
from study import options as common

Signal = Callable[[Array, np.random.Generator], Array]
RUNS, FINE = 3, 0.002
SYSTEMS = ["mass_spring_damper", "cartpole", "quadrotor"]
RATES = (20.0, 50.0, 100.0, 200.0, 500.0)
FLIGHT_RATES = (50.0, 100.0, 200.0, 250.0)
FLIGHTS = ("waypoints", "circle", "sines", "sticks", "hover")


def _waves(t: Array, rng: np.random.Generator) -> Array:
    f = rng.uniform(0.3, 1.6, 5)
    size = rng.uniform(0.3, 1.0, 5)
    waves = size[:, None] * np.sin(2 * np.pi * f[:, None] * t + rng.uniform(0, 6.3, (5, 1)))
    return np.asarray(waves.sum(0))


def _chirp(t: Array, rng: np.random.Generator) -> Array:
    low, high = 0.1, rng.uniform(2.0, 5.0)
    return np.asarray(1.5 * np.sin(2 * np.pi * (low * t + 0.5 * (high - low) / t[-1] * t * t)))


def _held(t: Array, rng: np.random.Generator, low: float, high: float, levels: Array) -> Array:
    edges = np.cumsum(rng.uniform(low, high, int(t[-1] / low) + 2))
    return np.asarray(rng.choice(levels, len(edges))[np.searchsorted(edges, t)])


def _prbs(t: Array, rng: np.random.Generator) -> Array:
    clock = rng.uniform(0.1, 0.3)
    return np.asarray(rng.choice((-1.2, 1.2), int(t[-1] / clock) + 2)[(t / clock).astype(int)])


def _ramps(t: Array, rng: np.random.Generator) -> Array:
    knots = np.cumsum(rng.uniform(0.8, 3.0, int(t[-1] / 0.8) + 2))
    return np.interp(t, knots, rng.uniform(-1.8, 1.8, len(knots)))


def _hand(t: Array, rng: np.random.Generator) -> Array:
    """Band-limited noise as of a hand on a knob: white noise through four low-pass filters of 0.1 s."""
    out = four_times(rng.standard_normal(len(t)), math.exp(-(t[1] - t[0]) / 0.1))
    return np.asarray(1.5 * out / out.std())


EXCITATIONS: dict[str, Signal] = {
    "waves": _waves,
    "one wave": lambda t, rng: 1.5 * np.sin(2 * np.pi * rng.uniform(0.3, 1.5) * t + rng.uniform(0, 6.3)),
    "chirp": _chirp,
    "steps": lambda t, rng: _held(t, rng, 1.0, 4.0, np.linspace(-1.5, 1.5, 7)),
    "PRBS": _prbs,
    "ramps": _ramps,
    "hand": _hand,
    "controller alone": lambda t, rng: 0.0 * t,
}
HABITS = (
    *("plain", "no noise", "large noise", "encoder", "3 decimals", "4 digits", "gyroscope", "tacho"),
    *("jitter", "lengths", "rest", "wrap"),
)


class Case(NamedTuple):
    """One log: its machine, excitation, habits and step [s], and the seed of all that is random in it."""

    name: str
    system: str
    excitation: str
    habits: tuple[str, ...]
    dt: float
    seed: int


def cases(seed: int, systems: list[str]) -> list[Case]:
    """Every excitation with every habit; every second log has a second habit."""
    out = []
    for system in systems:
        rng = np.random.default_rng([seed, *system.encode()])
        flying = system == "quadrotor"
        never = {"quadrotor": ("rest", "wrap"), "mass_spring_damper": ("wrap",)}.get(system, ())
        habits = [h for h in HABITS if h not in never]
        for excitation in FLIGHTS if flying else EXCITATIONS:
            for i, habit in enumerate(habits):
                second = str(rng.choice([h for h in habits if h != habit]))
                both = (habit, second) if i % 2 else (habit,)
                dt = 1.0 / float(rng.choice(FLIGHT_RATES if flying else RATES))
                name = f"{system}_{len(out):03d}"
                out.append(Case(name, system, excitation, both, dt, int(rng.integers(2**31))))
    return out


def _run(
    case: Case, p: dict[str, float], gust: float, noise: Array, seconds: float, k: int
) -> tuple[Array, ...]:
    """Times (n,), true states (n, nx) and forces (n, 1): held over a row, with a controller that sees noisy states."""
    rng = np.random.default_rng([case.seed, 1 + k])
    dt, cart = case.dt, case.system == "cartpole"
    t = dt * np.arange(round(seconds / dt) + 1)
    push = (3.0 if cart else 1.0) * EXCITATIONS[case.excitation](t, rng)
    rest = 3.0 if "rest" in case.habits else 0.0
    push[t < rest] = 0.0
    alone = case.excitation == "controller alone"
    goal = _held(t, rng, 2.0, 5.0, np.linspace(-0.6, 0.6, 7)) if alone else 0.0 * t
    goal[t < rest] = 0.0
    start = 0.0 if rest else 1.0
    y = [start * rng.uniform(-0.3, 0.3), 0.0]
    if cart:
        y = [0.0, 0.0, math.pi + start * rng.uniform(-0.8, 0.8), 0.0]
    fine = max(1, math.ceil(dt / FINE))
    h = dt / fine
    rows, forces = np.empty((len(t), len(y))), np.empty((len(t), 1))
    for i in range(len(t)):
        rows[i] = y
        seen = rows[i] + noise * rng.standard_normal(len(y))
        u = float(push[i])
        if (cart or alone) and t[i] >= rest:
            u -= (4.0 * (seen[0] - goal[i]) + 3.0 * seen[1]) / p["g"]
        forces[i] = u
        size = gust / math.sqrt(h) if t[i] >= rest else 0.0
        for _ in range(fine):
            white = (size * rng.standard_normal(), size * rng.standard_normal())
            y = step(lambda y, u=u, white=white: rate(case.system, p, y, u, *white), y, h)
    return t, rows, forces


def _seconds(case: Case, rng: np.random.Generator) -> list[float]:
    return (
        [float(s) for s in rng.permutation([4.0, 13.0, 41.0])] if "lengths" in case.habits else [20.0] * RUNS
    )


def _flights(case: Case) -> list[tuple[Array, ...]]:
    rng = np.random.default_rng([case.seed, 0])
    machine = _machine(case.system, rng)
    hover = case.excitation == "hover"
    path = "sticks" if hover else case.excitation
    flights = [
        Flight(machine, path, "b", s, 0.0, case.seed * 8 + k, 1.0, 0.05 if hover else 1.0, log=case.dt)
        for k, s in enumerate(_seconds(case, rng))
    ]
    return [(one.t, one.truth, one.u) for one in fly(flights)]


def _lagged(values: Array, dt: float, tau: float) -> Array:
    """Values (n, C) through a first-order low-pass."""
    out, keep = values.copy(), math.exp(-dt / tau)
    for k in range(1, len(out)):
        mean = 0.5 * (values[k] + values[k - 1])
        out[k] = keep * out[k - 1] + (1 - keep) * mean
    return out


def logged(case: Case, t: Array, true: Array, u: Array, noise: Array, k: int) -> tuple[Array, Array, Array]:
    """Times, states and inputs as they are written."""
    rng = np.random.default_rng([case.seed, 50 + k])
    flying = case.system == "quadrotor"
    rates = slice(10, 13) if flying else slice(1, None, 2)
    places = slice(0, 3) if flying else slice(0, None, 2)
    of_rates = slice(9, 12) if flying else rates
    std = noise * (0.0 if "no noise" in case.habits else 1.0) * (6.0 if "large noise" in case.habits else 1.0)
    if "gyroscope" in case.habits:
        std[of_rates] = std[of_rates] * np.exp(np.random.default_rng([case.seed, 49]).uniform(-2.0, 2.0))
    if "encoder" in case.habits:
        std[places] = 0.0
    true = true.copy()
    if "tacho" in case.habits and case.dt < 0.02:
        true[:, rates] = _lagged(true[:, rates], case.dt, 1.0 / (2 * np.pi * 40.0))
    white = std * rng.standard_normal((len(t), len(std)))
    x = measured(true, white) if flying else true + white
    if "encoder" in case.habits:
        grain = 0.001 if flying else 2 * np.pi / 4096.0
        x[:, places] = grain * np.round(x[:, places] / grain)
    if "wrap" in case.habits:
        x[:, 2] = np.remainder(x[:, 2] + np.pi, 2 * np.pi) - np.pi
    if "jitter" in case.habits:
        t = t + 0.01 * case.dt * rng.standard_normal(len(t))
    return t, x, u


def write(case: Case, folder: Path) -> None:
    flying = case.system == "quadrotor"
    runs, noise = _flights(case) if flying else [], SENSORS
    if not flying:
        rng, quiet = np.random.default_rng([case.seed, 0]), "no noise" in case.habits
        machine = small(case.system, rng, effect=False)
        noise = np.array(machine.noise)
        gust = 0.0 if quiet else float(rng.choice((0.0, 0.02)))
        how = machine.values, gust, noise * (0.0 if quiet else 1.0)
        runs = [_run(case, *how, s, k) for k, s in enumerate(_seconds(case, rng))]
    names = columns("multirotor", 4) if flying else columns(case.system)
    for k, run in enumerate(runs):
        t, x, u = logged(case, *run, noise, k)
        time = "%.7g" if "jitter" in case.habits else "%.6g"
        other = "%.3f" if "3 decimals" in case.habits else "%.4g" if "4 digits" in case.habits else "%.9g"
        formats = [time, *[other] * (x.shape[1] + u.shape[1])]
        save(folder / "data" / case.name / f"run_{k}.csv", names, [t, x, u], formats)


def options(doc: str | None, **how: Any) -> argparse.ArgumentParser:
    parser = common(doc, "seed", **how)
    parser.add_argument("--systems", nargs="+", default=SYSTEMS)
    return parser


def main() -> None:
    given = options(__doc__, out=Path("sound")).parse_args()
    for case in cases(given.seed, given.systems):
        if not (given.out / "data" / case.name / f"run_{RUNS - 1}.csv").is_file():
            write(case, given.out)
            print(case.name, flush=True)


if __name__ == "__main__":
    main()
