"""Blind closed-loop cases: flights of hexacopters and quadrotors under feedback that hold one effect, or nothing.

    python benchmarks/blind/closed_loop.py --seed 1 --out loop/          # 60 cases in five minutes

Machines, controllers, gusts, sensors and paths are those of `loop_machine` and `loop_flight`, which share no code with
`nsde_torch`; files do not say what is in them. 48 cases hold one effect of the catalogue, 12 hold nothing. Systems, the
four regimes and whether sticks and setpoints are logged take turns, so that each effect is seen under three regimes,
and nothing under all. Four flights of 40 to 45 s a case, on one clock; the battery's voltage is always logged.
"""

import time
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from loop_flight import RATES, REGIMES, STICKS, Flight, Logged, fly, several
from loop_machine import SIGNS, Machine
from study import columns, missing, options, save, write_json

SYSTEMS = ("hexacopter", "quadrotor")
SINGLES, NULLS = 48, 12
FLIGHTS = 4
EFFECTS = (
    *("linear_drag", "quadratic_drag", "constant_wind", "constant_world_force", "ground_effect"),
    *("thrust_misalignment", "angular_damping", "com_offset", "gyroscopic_moment", "flapping_moment"),
    *("inertia_coupling", "motor_lag", "input_delay", "motor_efficiency_loss", "thrust_sag"),
    "battery_voltage",
)


class Case(NamedTuple):
    name: str  # of its files; tells nothing
    machine: Machine
    regime: str  # what its controller sees
    sticks: bool  # whether sticks and setpoints are logged
    seed: int


def cases(seed: int, count: int = SINGLES + NULLS) -> list[Case]:
    """The cases of a seed, in an order that tells nothing; fewer of them are the first of that order."""
    order = np.random.default_rng([seed, 0])
    names = [EFFECTS[i] for i in order.permutation(len(EFFECTS))]
    plans: list[tuple[str, str, str, bool]] = []
    for i in range(SINGLES):
        turn, e = divmod(i, len(EFFECTS))
        system = SYSTEMS[(e // 8 + (turn + 1) // 2) % 2]
        plans.append((names[e], system, REGIMES[(e + turn) % 4], (e // 4 + turn) % 2 == 0))
    plans += [("", SYSTEMS[(i + i // 4) % 2], REGIMES[i % 4], (i // 4) % 2 == 0) for i in range(NULLS)]
    made = []
    for k, i in enumerate(order.permutation(len(plans))[:count].tolist()):
        rng = np.random.default_rng([seed, 1, i])
        name, system, regime, logged = plans[i]
        machine = replace(_machine(system, rng), effects={name: _sized(name, system, rng)} if name else {})
        made.append(Case(f"case_{k:02d}", machine, regime, logged, int(rng.integers(2**31))))
    return made


def _machine(system: str, rng: np.random.Generator) -> Machine:
    """A machine with random parameters that hovers at 0.33 to 0.5."""
    offset = float(rng.uniform(-1.2, 0.0))
    gain = (9.81 - offset) / (SIGNS[system].shape[1] * rng.uniform(0.33, 0.5))
    roll = rng.uniform(70, 130) if system == "hexacopter" else rng.uniform(40, 75)
    jx = rng.uniform(0.5, 0.7)
    moments = (float(roll), float(roll * rng.uniform(0.85, 1.15)), float(rng.uniform(2.5, 5.0)))
    inertia = (float(jx), float(jx * rng.uniform(0.85, 1.15)))
    gust = tuple(rng.uniform(0.7, 1.3) * np.array([0.15, 0.15, 0.1, 0.5, 0.5, 0.12]))
    times = (float(rng.uniform(0.3, 1.0)), float(rng.uniform(0.03, 0.12)))
    return Machine(system, float(gain), offset, moments, inertia, {}, gust, times)


def _sized(name: str, system: str, rng: np.random.Generator) -> dict[str, Any]:
    """Parameters of an effect of random size, from visible to strong."""

    def size(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    def signed(low: float, high: float, count: int) -> list[float]:
        return [float(rng.choice((-1.0, 1.0)) * size(low, high)) for _ in range(count)]

    motors = SIGNS[system].shape[1]
    side = size(0.12, 0.5)
    drag = [side, side * float(rng.uniform(0.8, 1.25)), side * float(rng.uniform(0.3, 1.0))]
    loss = np.zeros(motors)
    loss[rng.integers(motors)] = size(0.03, 0.12)
    angle = rng.uniform(0, 2 * np.pi)
    wind = size(1.0, 3.0) * np.array([np.cos(angle), np.sin(angle)])
    made: dict[str, dict[str, Any]] = {
        "linear_drag": {"drag": drag},
        "quadratic_drag": {"drag": [0.4 * d for d in drag]},
        "rotor_drag": {"drag": drag},
        "translational_lift": {"lift": 0.1 * side},
        "constant_wind": {"drag": drag, "wind": wind.tolist()},
        "constant_world_force": {"acceleration": signed(0.1, 0.5, 3)},
        "ground_effect": {"area": size(0.01, 0.05), "height": float(rng.uniform(0.1, 0.3))},
        "thrust_misalignment": {"tilt": signed(0.01, 0.05, 2)},
        "angular_damping": {"damping": [size(0.5, 2.5) for _ in range(3)]},
        "com_offset": {"offset": signed(0.05, 0.3, 2)},
        "gyroscopic_moment": {"momentum": size(3.0, 15.0)},
        "flapping_moment": {"gain": [size(0.5, 3.0), size(0.5, 3.0)]},
        "inertia_coupling": {"product": signed(0.03, 0.12, 3)},
        "motor_lag": {"time_constant": size(0.02, 0.07)},
        "input_delay": {"delay": round(size(0.01, 0.04), 3)},
        "motor_efficiency_loss": {"loss": loss.tolist()},
        "thrust_sag": {"rate": size(0.0002, 0.0008)},
        "battery_voltage": {"sensitivity": size(0.02, 0.08)},
    }
    return made[name]


def flights_of(case: Case) -> list[Flight]:
    """The four flights of a case: no two paths alike, one of them often flown by stick."""
    rng = np.random.default_rng([case.seed, 0])
    seconds = lambda: float(np.round(rng.uniform(40.0, 45.0), 2))  # noqa: E731
    return several(case.machine, rng, case.regime, case.seed * 8, FLIGHTS, seconds)


def write(case: Case, logged: list[Logged], folder: Path) -> None:
    """Write the flights of a case to `folder/data/NAME`, and its truth to `folder/truth/NAME.json`, last."""
    extra = [*(STICKS if case.sticks else ()), *(RATES if case.sticks else ()), "battery_voltage"]
    for k, run in enumerate(logged):
        names = [*columns("multirotor", run.u.shape[1]), *extra]
        table = [np.round(run.t, 6), run.x, run.u, *(run.extra[name] for name in extra)]
        save(folder / "data" / case.name / f"run_{k}.csv", names, table)
    m = case.machine
    content = {
        "system": m.system,
        "regime": case.regime,
        "sticks": case.sticks,
        "exogenous": list(STICKS) if case.sticks else [],
        "effects": m.effects,
        "declared": m.declared,
        "gust": m.gust,
        "gust_time_s": m.gust_time,
        "flights": [[f.path, f.seconds, f.sensor_noise, f.vigour] for f in flights_of(case)],
        "seed": case.seed,
    }
    write_json(folder / "truth" / f"{case.name}.json", content)


def main() -> None:
    given = options(__doc__, "seed", "out", count=SINGLES + NULLS, names=None).parse_args()
    every = {c.name: c for c in cases(given.seed, given.count) if c.name in (given.names or [c.name])}
    todo = [every[name] for name in missing(given.out, "truth", every)]
    started = time.perf_counter()
    for regime in REGIMES:
        some = [c for c in todo if c.regime == regime]
        if not some:
            continue
        logged = fly([f for c in some for f in flights_of(c)])
        for k, case in enumerate(some):
            write(case, logged[FLIGHTS * k : FLIGHTS * (k + 1)], given.out)
        spent = time.perf_counter() - started
        print(f"{len(some)} cases of one regime written ({spent:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
