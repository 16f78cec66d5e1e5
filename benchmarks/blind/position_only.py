"""Blind cases whose position alone is measured, each diagnosed beside the same run with a sensor of the rate.

Machines in turn: spring, cart, two joints (`position_machines`, `two_joints`), with other values, seeds, noise and
encoders in each case; one effect, or none; the rate is missing or made by a user in one of four ways. It counts whether
the effect that is there is named first, what is named of nothing, and whether 90 % intervals of its size hold.

    python benchmarks/blind/position_only.py --seed 1 --count 30 --out runs/position_only
"""

from __future__ import annotations

import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
from position_machines import RATES, Array, Law, cart, measured, rates, spring
from study import Json, answers, options, save
from two_joints import drawn, laws, make_data

MACHINES = {
    "mass_spring_damper": ("q", "q_dot", "force"),
    "cartpole": ("x", "x_dot", "theta", "theta_dot", "force"),
    "double_pendulum:DoublePendulum": ("q1", "q2", "q1_dot", "q2_dot", "tau1", "tau2"),
}
RATE_COLUMNS = {
    "mass_spring_damper": {0: 1},
    "cartpole": {0: 1, 2: 3},
    "double_pendulum:DoublePendulum": {0: 2, 1: 3},
}
NAMED = (
    "coulomb_friction",
    "viscous_friction",
    "quadratic_damping",
    "cubic_stiffness",
    "asymmetric_friction",
)


def _of_one_body(
    i: int, rng: np.random.Generator
) -> tuple[str, dict[str, dict[str, float]], list[Array], float]:
    """System, true effects, true runs and step of a spring or a cart."""
    on_cart = i % 3 == 1
    known = laws(rng, float(rng.uniform(1.5, 3.0)) * (2.0 if on_cart else 1.0), 1.0 if on_cart else 1.3)
    able = [n for n in NAMED if n in known and (on_cart or n != "viscous_friction")]
    name = able[int(rng.integers(len(able)))]
    law: Law = lambda q, v: 0.0  # noqa: E731
    truth: dict[str, dict[str, float]] = {}
    if i % 4 != 3:
        law, truth = known[name][0], {f"{name}[cart]" if on_cart else name: known[name][1]}
    dt = float(rng.choice([0.005, 0.01]))
    if on_cart:
        values = {
            "g": rng.uniform(0.6, 1.3),
            "s": rng.uniform(0.06, 0.25),
            "l": rng.uniform(0.25, 0.7),
            "force": 6.0,
        }
    else:
        values = {
            "k": rng.uniform(1.0, 8.0),
            "b": rng.uniform(0.2, 0.7),
            "g": rng.uniform(0.6, 2.0),
            "force": 2.5,
        }
    make = cart if on_cart else spring
    gust = float(rng.choice([0.01, 0.05]))
    runs = [
        np.column_stack(
            make(values, law, seconds=15.0, dt=dt, gust=gust, rng=np.random.default_rng(rng.integers(2**31)))
        )
        for _ in range(4)
    ]
    return ("cartpole" if on_cart else "mass_spring_damper"), truth, runs, dt


def _of_joints(seed: int, i: int) -> tuple[str, dict[str, dict[str, float]], list[Array], float]:
    """The same of two joints; one effect, or none."""
    kind, truth, push = drawn(seed, 4 * i + (3 if i % 4 == 3 else 0))
    assert kind == ("null" if i % 4 == 3 else "single")
    runs = [make_data.kept(1200, np.random.default_rng([seed, i, k]), push, 0.0) for k in range(4)]
    return "double_pendulum:DoublePendulum", truth, runs, make_data.DT


def recorded(
    seed: int, i: int, *, full: bool, how: str | None = None
) -> tuple[str, dict[str, dict[str, float]], Any, Json]:
    """System, true effects, data set and facts of a case, with a sensor of the rate (`full`) or without.

    Args:
        seed: Of the study.
        i: Number of the case.
        full: Whether the rate is measured.
        how: What the user did for a rate (`position_machines.RATES`); None: by the number of the case.
    """
    import nsde_torch

    rng = np.random.default_rng([seed, i])
    joints = i % 3 == 2
    system, truth, runs, dt = _of_joints(seed, i) if joints else _of_one_body(i, rng)
    noise, counts = float(rng.choice([3e-4, 1e-3])), bool(rng.integers(2))
    how = how or RATES[i % len(RATES)]
    columns = RATE_COLUMNS[system]
    with tempfile.TemporaryDirectory() as folder:
        for k, run in enumerate(runs):
            table, names = run.copy(), list(MACHINES[system])
            for p, v in columns.items():
                table[:, p] = measured(run[:, p], noise, counts, rng)
                table[:, v] += 10.0 * noise * rng.standard_normal(len(run))
                if not full and how != "none":
                    table[:, v] = rates(table[:, p], dt, how)
            keep = [c for c in range(len(names)) if full or how != "none" or c not in columns.values()]
            t = dt * np.arange(len(run)) + 100.0 * k
            kept = ("t", *(names[c] for c in keep))
            save(Path(folder) / f"run_{k}.csv", kept, [t, table[:, keep]], "%.7f")
        data = nsde_torch.read(folder, system=system)
    return system, truth, data, {"rate": "sensor" if full else how, "noise": noise, "counts": counts}


def case(seed: int, i: int, *, full: bool) -> dict[str, Any]:
    """Make and diagnose one case, with a sensor of the rate (`full`) or without."""
    import torch

    import nsde_torch

    torch.set_num_threads(1)
    system, truth, data, told = recorded(seed, i, full=full)
    found = nsde_torch.diagnose(data, system=system).content()
    inside = held = 0
    for effect, values in truth.items():
        for name, value in values.items():
            interval = found["parameters"].get(f"{effect}.{name}", {}).get("interval_90")
            if interval:
                held += 1
                inside += int(interval[0] <= value <= interval[1])
    added = [f["name"] for f in found["findings"] if f["kind"] == "effect"]
    sure = [f["name"] for f in found["findings"] if f["kind"] == "effect" and not f["lead"]]
    return {
        "case": i,
        "system": system,
        "full": full,
        **told,
        "truth": truth,
        "inferred": sorted({n for run in data.runs for n in run.inferred}),
        "verdict": found["verdict"],
        "added": added,
        "named": added[:1] == list(truth)[:1] if truth else not sure,
        "wrong_and_sure": [n for n in sure if n not in truth],
        "parameters": {k: [v["value"], v["interval_90"]] for k, v in found["parameters"].items()},
        "inside": [inside, held],
    }


def main() -> None:
    """Diagnoses cases one after another, and counts."""
    a = options("Blind cases whose position alone is measured.", count=30).parse_args()

    def line(answer: Json) -> str:
        keys = ("named", "truth", "added", "rate", "verdict", "inside", "error")
        what = "full" if answer["full"] else "position"
        return f"{answer['case']} {what} { {k: answer.get(k) for k in keys} }"

    cases = [
        (
            f"seed_{a.seed}_case_{i:03d}_{'full' if full else 'position'}",
            partial(case, a.seed, i, full=full),
            {"case": i, "full": full, "named": False, "inside": [0, 0]},
        )
        for i in range(a.first, a.first + a.count)
        for full in (False, True)
    ]
    done = answers(a.out, cases, line)
    for full in (False, True):
        some = [x for x in done if x["full"] == full]
        inside, held = (sum(x["inside"][k] for x in some) for k in (0, 1))
        wrong = sum(bool(x.get("wrong_and_sure")) for x in some)
        print(
            "full" if full else "position",
            f"named {sum(x['named'] for x in some)} of {len(some)}, intervals hold {inside} of {held},",
            f"wrong and sure {wrong}",
        )


if __name__ == "__main__":
    main()
