"""Machines of MuJoCo with effects that nobody declared: named, and values in their intervals.

    pip install mujoco
    python benchmarks/blind/mujoco_study.py --seed 1 --count 15 --out runs/mujoco

Case i holds kind i of `mujoco_machines.KINDS`, with a size drawn by the seed. An effect counts as found where it is
among what was added; what else was added is told beside it.
"""

from __future__ import annotations

import math
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))
import mujoco_machines as machines
from study import answers, options

Json = dict[str, Any]


def diagnosed(kind: str, seed: int) -> Json:
    """Simulate a case and diagnose it."""
    import torch

    import nsde_torch

    torch.set_num_threads(1)
    plant, _ = machines.KINDS[kind]
    system = "cartpole" if plant is machines.CartOnRail else "quadrotor"
    with tempfile.TemporaryDirectory() as folder:
        truth = machines.write(kind, seed, Path(folder))
        start = time.perf_counter()
        found = nsde_torch.diagnose(folder, system=system)
    content = found.content()
    return {
        "kind": kind,
        "seed": seed,
        "truth": truth,
        "declared_truth": plant.values,
        "verdict": found.verdict,
        "added": found.added,
        "leads": [f.name for f in found.outcome.found if f.provisional],
        "ties": content["ties"],
        "parameters": found.parameters,
        "declared": content["declared_parameters"],
        "seconds": time.perf_counter() - start,
    }


def judge(answer: Json) -> str:
    """Add to an answer what it is worth; returns a line."""
    names = {label.partition(".")[0] for label in answer["truth"]}
    added = answer.get("added", [])
    answer["named"] = names <= set(added)
    answer["others"] = [name for name in added if name not in names]
    told = []
    truths = {**answer["truth"], **answer.get("declared_truth", {})}
    for label, value in truths.items():
        found = answer.get("parameters", {}).get(label) or answer.get("declared", {}).get(label)
        if found is None or math.isnan(value) or not found.get("interval_90"):
            continue
        low, high = found["interval_90"]
        told.append(
            {"parameter": label, "truth": value, "found": found["value"], "holds": low <= value <= high}
        )
    answer["values"] = told
    word = "named" if answer["named"] else "NOT named"
    word = word if names else ("silent" if not added else "NOT silent")
    values = ", ".join(
        f"{v['parameter']} {v['found']:.4g} of {v['truth']:.4g}{'' if v['holds'] else ' OUTSIDE'}"
        for v in told
        if v["parameter"] in answer["truth"]
    )
    beside = f"; beside it {', '.join(answer['others'])}" if names and answer["others"] else ""
    return f"{answer['kind']:18} {word}{beside}; {values} ({answer.get('seconds', math.nan):.0f} s)"


def main() -> None:
    """Run or go on, and print the table."""
    args = options(__doc__ or "", count=len(machines.KINDS)).parse_args()
    kinds = list(machines.KINDS)
    cases = []
    for i in range(args.first, args.first + args.count):
        kind, seed = kinds[i % len(kinds)], args.seed + i // len(kinds)
        wrong = {"kind": kind, "seed": seed, "truth": {"nothing": math.nan}, "added": []}
        cases.append((f"{kind}_{seed}", partial(diagnosed, kind, seed), wrong))
    done = answers(args.out, cases, judge)
    single = [a for a in done if a["truth"]]
    nulls = [a for a in done if not a["truth"]]
    values = [v for a in done for v in a["values"]]
    of_effects = [v for a in done for v in a["values"] if v["parameter"] in a["truth"]]
    print(
        f"\n{sum(a['named'] for a in single)} of {len(single)} named, "
        f"{sum(a['named'] and not a['others'] for a in single)} with nothing beside; "
        f"{sum(not a['added'] for a in nulls)} of {len(nulls)} nulls silent; 90 % intervals that hold: "
        f"{sum(v['holds'] for v in of_effects)} of {len(of_effects)} of effects, "
        f"{sum(v['holds'] for v in values)} of {len(values)} in all"
    )


if __name__ == "__main__":
    main()
