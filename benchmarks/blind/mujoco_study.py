"""Machines of MuJoCo with effects that nobody declared: named, and values in their intervals.

    pip install mujoco
    python benchmarks/blind/mujoco_study.py --seed 1 --count 15 --out runs/mujoco

Case i holds kind i of `mujoco_machines.KINDS`, with a size drawn by the seed. An effect counts as found where it is
among what was added; what else was added is told beside it.
"""

from __future__ import annotations

import math

import mujoco_machines as machines
from study import Json, answers, holds, in_turn, options, written


def diagnosed(kind: str, seed: int) -> Json:
    plant, _ = machines.KINDS[kind]
    system = "cartpole" if plant is machines.CartOnRail else "quadrotor"
    truth, _, answer = written(lambda folder: machines.write(kind, seed, folder), system)
    return {"kind": kind, "seed": seed, "truth": truth, "declared_truth": plant.values, **answer}


def judge(answer: Json) -> str:
    """Add to an answer what it is worth; returns a line."""
    names = {label.partition(".")[0] for label in answer["truth"]}
    added = answer["added"]
    answer["named"] = names <= set(added)
    answer["others"] = [name for name in added if name not in names]
    told = answer["values"] = []
    for label, value in {**answer["truth"], **answer.get("declared_truth", {})}.items():
        found = answer.get("parameters", {}).get(label) or answer.get("declared", {}).get(label)
        if found and not math.isnan(value) and found.get("interval_90"):
            held = holds({"interval_90": found["interval_90"]}, value)
            told.append({"parameter": label, "truth": value, "found": found["value"], "holds": held})
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
    kinds = list(machines.KINDS)
    a = options(__doc__, "seed", "out", first=0, count=len(kinds)).parse_args()
    done = answers(a.out, in_turn(a, kinds, diagnosed, truth={"nothing": math.nan}, added=[]), judge)
    single, nulls = [x for x in done if x["truth"]], [x for x in done if not x["truth"]]
    values = [v for x in done for v in x["values"]]
    of_effects = [v["holds"] for x in done for v in x["values"] if v["parameter"] in x["truth"]]
    alone = sum(x["named"] and not x["others"] for x in single)
    print(
        f"\n{sum(x['named'] for x in single)} of {len(single)} named, {alone} with nothing beside; "
        f"{sum(not x['added'] for x in nulls)} of {len(nulls)} nulls silent; 90 % intervals that hold: "
        f"{sum(of_effects)} of {len(of_effects)} of effects, {sum(v['holds'] for v in values)} of {len(values)} in all"
    )


if __name__ == "__main__":
    main()
