"""Blind cases whose position alone is measured, each diagnosed beside the same run with a sensor of the rate.

    python benchmarks/blind/position_only.py --seed 1 --count 30 --out runs/position_only
    python benchmarks/blind/position_only.py --seed 6007 --count 48 --out runs/position_values --values

Machines in turn: spring, cart, two joints (`small_machines`, `two_joints`), with other values, seeds, noise and
encoders in each case; one effect, or none; the rate is missing or made by a user in one of four ways. `--values`
identifies each case with the true effects declared, from first values that are 30 % off.
"""

import tempfile
from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from small_machines import RATES, Law, cart, measured, rates, spring
from study import Array, Json, answers, diagnosed, judged, numbered, options, save, table
from two_joints import SYSTEM as JOINTS
from two_joints import drawn, laws, make_data

SPRING, CART = "mass_spring_damper", "cartpole"
MACHINES = {
    SPRING: ("q", "q_dot", "force"),
    CART: ("x", "x_dot", "theta", "theta_dot", "force"),
    JOINTS: ("q1", "q2", "q1_dot", "q2_dot", "tau1", "tau2"),
}
RATE_COLUMNS = {SPRING: {0: 1}, CART: {0: 1, 2: 3}, JOINTS: {0: 2, 1: 3}}
NAMED = [
    "coulomb_friction",
    "viscous_friction",
    "quadratic_damping",
    "cubic_stiffness",
    "asymmetric_friction",
]
OFF = 1.3  # first values over the true ones
Truth = dict[str, dict[str, float]]


def _of_one_body(i: int, rng: np.random.Generator) -> tuple[str, Truth, list[Array], float]:
    """System, true effects, true runs and step of a spring or a cart."""
    on_cart = i % 3 == 1
    known = laws(rng, float(rng.uniform(1.5, 3.0)) * (2.0 if on_cart else 1.0), 1.0 if on_cart else 1.3)
    able = [n for n in NAMED if n in known and (on_cart or n != "viscous_friction")]
    name = able[int(rng.integers(len(able)))]
    law: Law = lambda q, v: 0.0  # noqa: E731
    truth: Truth = {}
    if i % 4 != 3:
        law, truth = known[name][0], {f"{name}[cart]" if on_cart else name: known[name][1]}
    how: dict[str, Any] = {"seconds": 15.0, "dt": float(rng.choice([0.005, 0.01]))}
    ends = {"g": (0.6, 1.3), "s": (0.06, 0.25), "l": (0.25, 0.7)}
    ends = ends if on_cart else {"k": (1.0, 8.0), "b": (0.2, 0.7), "g": (0.6, 2.0)}
    values = {k: rng.uniform(*of) for k, of in ends.items()} | {"force": 6.0 if on_cart else 2.5}
    how["gust"] = float(rng.choice([0.01, 0.05]))
    runs = []
    for _ in range(4):
        own = np.random.default_rng(rng.integers(2**31))
        runs.append(np.column_stack((cart if on_cart else spring)(values, law, rng=own, **how)))
    return CART if on_cart else SPRING, truth, runs, how["dt"]


def recorded(seed: int, i: int, *, full: bool, how: str | None = None) -> tuple[str, Truth, Any, Json]:
    """System, true effects, data set and facts of a case, with a sensor of the rate (`full`) or without.

    `how` is what the user did for a rate (`small_machines.RATES`); None: by the number of the case.
    """
    import nsde_torch

    rng = np.random.default_rng([seed, i])
    if i % 3 == 2:  # two joints; one effect, or none
        _, truth, push = drawn(seed, 4 * i + (3 if i % 4 == 3 else 0))
        runs = [make_data.kept(1200, np.random.default_rng([seed, i, k]), push, 0.0) for k in range(4)]
        system, dt = JOINTS, make_data.DT
    else:
        system, truth, runs, dt = _of_one_body(i, rng)
    noise, counts = float(rng.choice([3e-4, 1e-3])), bool(rng.integers(2))
    how = how or RATES[i % len(RATES)]
    columns, names = RATE_COLUMNS[system], MACHINES[system]
    keep = [c for c in range(len(names)) if full or how != "none" or c not in columns.values()]
    with tempfile.TemporaryDirectory() as folder:
        for k, run in enumerate(runs):
            table = run.copy()
            for p, v in columns.items():
                table[:, p] = measured(run[:, p], noise, counts, rng)
                table[:, v] += 10.0 * noise * rng.standard_normal(len(run))
                if not full and how != "none":
                    table[:, v] = rates(table[:, p], dt, how)
            t = dt * np.arange(len(run)) + 100.0 * k
            save(Path(folder) / f"run_{k}.csv", ("t", *(names[c] for c in keep)), [t, table[:, keep]], "%.7f")
        data = nsde_torch.read(folder, system=system)
    return system, truth, data, {"rate": "sensor" if full else how, "noise": noise, "counts": counts}


def case(seed: int, i: int, *, full: bool) -> Json:
    """Make and diagnose one case, with a sensor of the rate (`full`) or without."""
    system, truth, data, told = recorded(seed, i, full=full)
    found, answer = diagnosed(data, system)
    effects = [f for f in found.content()["findings"] if f["kind"] == "effect"]
    answer["added"], answer["sure"] = (
        [f["name"] for f in effects],
        [f["name"] for f in effects if not f["lead"]],
    )
    right = None if truth else not answer["sure"]
    inferred = sorted({n for run in data.runs for n in run.inferred})
    return {"system": system, **told, "inferred": inferred, **judged(answer, truth, right=right)}


def identified(seed: int, i: int) -> Json:
    """Identify one case with its laws told; nothing to identify where there is no effect."""
    from nsde_torch.sysid import identify_in_loop
    from nsde_torch.systems import make_system

    system, truth, data, told = recorded(seed, i, full=False, how="none")
    true = {f"{e}.{n}": float(x) for e, values in truth.items() for n, x in values.items()}
    off: dict[str, float | None] = {}
    if true:
        values = {label: OFF * value for label, value in true.items()}
        found = identify_in_loop(make_system(system, effects=list(truth), values=values), data.runs)
        half = found.half_widths(0.9)
        for label, value in true.items():
            j = found.vector.labels.index(label)
            off[label] = float((found.values[j] - value) / half[j]) if np.isfinite(half[j]) else None
    return {"case": i, "system": system, **told, "truth": true, "off": off}


def report_values(done: list[Json]) -> None:
    """How many intervals hold by machine, and how far estimates are off."""
    by_system: dict[str, list[float]] = defaultdict(list)
    for answer in done:
        by_system[str(answer.get("system"))] += [v for v in answer["off"].values() if v is not None]
    for system, off in by_system.items():
        away = np.array(off)
        if len(away):
            held, rms = int((np.abs(away) <= 1).sum()), np.sqrt(np.mean(away**2))
            off = f"half-widths off: mean {away.mean():+.2f}, rms {rms:.2f}"
            print(f"{system}: {held} of {len(away)} intervals hold; {off}")


def main() -> None:
    parser = options(__doc__, "seed", "out", first=0, count=30)
    parser.add_argument("--values", action="store_true", help="values where the laws are given")
    a = parser.parse_args()
    if a.values:
        keys, cases = ("system", "off", "error"), numbered(a, identified)
        say = lambda x: " ".join(str(x.get(k, "")) for k in keys)  # noqa: E731
        report_values(answers(a.out, cases, say, {"off": {}}))
        return
    kinds = ("position", False), ("full", True)
    table(answers(a.out, [c for kind, full in kinds for c in numbered(a, partial(case, full=full), kind)]))


if __name__ == "__main__":
    main()
