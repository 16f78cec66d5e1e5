"""Good logs and broken ones: does a command name what is wrong with a log, and is it silent where nothing is?

    python benchmarks/blind/broken_logs.py --seed 1 --count 100 --out broken/

writes as many good logs as broken ones, and their truth. Of five logs three are of multirotors in closed loop
(`loop_flight`), one of a spring and one of a cart (`small_machines`). Every second machine holds one true effect that
the declared physics lacks. Broken logs hold one fault of `broken_faults`, each in turn. None of it shares code with
`nsde_torch`.
"""

import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from broken_faults import FAULTS, Log, Table
from closed_loop import EFFECTS, SYSTEMS, _machine, _sized
from loop_flight import Flight, fly, several
from small_machines import Small, run, small
from study import Json, columns, missing, options, save, write_json

LOOPS = (("a", 0.01), ("b", 0.02), ("c", 0.01), ("a", 0.005), ("d", 0.01), ("b", 0.004))
"""Regime and step of the log [s] of the multirotors, in turn."""
STEPS = (0.01, 0.02, 0.005, 0.0025)
RUNS = 3


class Case(NamedTuple):
    name: str
    system: str
    fault: str  # key of `FAULTS`; empty for a good log
    effect: str  # true effect that the declared physics lacks; empty for none
    regime: str  # of a multirotor's loop
    dt: float  # step [s]
    seed: int


def cases(seed: int, count: int) -> list[Case]:
    rng = np.random.default_rng([seed, 0])
    out = []
    names = list(FAULTS)
    order = np.concatenate([rng.permutation(len(names)) for _ in range(count // len(names) + 1)])
    effects = np.concatenate([rng.permutation(len(EFFECTS)) for _ in range(2 * count // len(EFFECTS) + 1)])
    flown = 0
    for i in range(2 * count):
        fault = names[order[i // 2]] if i % 2 else ""
        kinds = FAULTS[fault][1] if fault else "msc"
        kind = "mmmsc"[(i // 2) % 5]
        kind = kind if kind in kinds else kinds[0]
        system = {"m": SYSTEMS[int(rng.integers(2))], "s": "mass_spring_damper", "c": "cartpole"}[kind]
        regime, dt = LOOPS[flown % len(LOOPS)] if kind == "m" else ("", float(rng.choice(STEPS)))
        flown += kind == "m"
        effect = (EFFECTS[effects[i]] if kind == "m" else "friction") if (i // 2) % 2 else ""
        name = f"{'broken' if fault else 'good'}_{i // 2:03d}"
        out.append(Case(name, system, fault, effect, regime, dt, int(rng.integers(2**31))))
    return out


def flights_of(case: Case, turn: int) -> list[Flight]:
    """Flights of the case's machine, or with `turn` 1 those of another machine of the kind."""
    rng = np.random.default_rng([case.seed, turn])
    machine = _machine(case.system, rng)
    if case.effect and not turn:
        machine = replace(machine, effects={case.effect: _sized(case.effect, case.system, rng)})
    seconds = lambda: float(np.round(rng.uniform(20.0, 30.0), 1))  # noqa: E731
    return several(machine, rng, case.regime, case.seed * 16 + 8 * turn, RUNS, seconds, case.dt)


def small_log(case: Case, turn: int) -> tuple[Log, Small]:
    rng = np.random.default_rng([case.seed, turn])
    machine = small(case.system, rng, bool(case.effect) and not turn)
    log, t0 = [], 0.0
    for k in range(RUNS):
        seconds = float(np.round(rng.uniform(15.0, 30.0), 1))
        t, x, u = run(machine, seconds, case.dt, case.seed * 16 + 8 * turn + k)
        log.append(Table(t0 + t, x, u))
        t0 = round(t0 + seconds + 5.0, 2)
    return log, machine


def write(case: Case, log: Log, other: Log | None, true: Json, folder: Path) -> None:
    """Break the log, and write it and its truth, the truth last."""
    rng = np.random.default_rng([case.seed, 99])
    done = FAULTS[case.fault][0](log, other or log, rng) if case.fault else ""
    names = columns("multirotor", log[0].u.shape[1]) if case.regime else columns(case.system)
    for k, one in enumerate(log):
        table = [np.round(one.t, 6), one.x, one.u, *one.extra.values()]
        save(folder / "data" / case.name / f"run_{k}.csv", [*names, *one.extra], table)
    about = {key: getattr(case, key) for key in ("name", "system", "fault", "effect", "regime")}
    content = {**about, "dt_s": case.dt, "done": done, "true": true}
    write_json(folder / "truth" / f"{case.name}.json", content)


def main() -> None:
    given = options(__doc__, "seed", "out", count=100).parse_args()
    every = {c.name: c for c in cases(given.seed, given.count)}
    todo = [every[name] for name in missing(given.out, "truth", every)]
    started = time.perf_counter()
    for case in (c for c in todo if not c.regime):
        log, machine = small_log(case, 0)
        true = {"values": machine.values, "effects": machine.effects}
        write(case, log, small_log(case, 1)[0], true, given.out)
    print(f"springs and carts written ({time.perf_counter() - started:.0f} s)", flush=True)
    for regime, dt in LOOPS:
        some = [c for c in todo if (c.regime, c.dt) == (regime, dt)]
        wanted = [(c, turn) for c in some for turn in (0, *((1,) if "machine" in c.fault else ()))]
        if not wanted:
            continue
        logged = fly([f for c, turn in wanted for f in flights_of(c, turn)])
        tables = [Table(x.t, x.x, x.u, {"battery_voltage": x.extra["battery_voltage"]}) for x in logged]
        logs = {(c.name, turn): tables[RUNS * n : RUNS * (n + 1)] for n, (c, turn) in enumerate(wanted)}
        for case in some:
            m = flights_of(case, 0)[0].machine
            true = {**m.declared, "effects": m.effects}
            write(case, logs[case.name, 0], logs.get((case.name, 1)), true, given.out)
        spent = time.perf_counter() - started
        print(f"{len(some)} logs of regime {regime} at {1 / dt:g} Hz written ({spent:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
