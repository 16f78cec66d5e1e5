"""Machines of MuJoCo with effects that nobody declared: named, and values in their intervals.

    pip install mujoco
    python benchmarks/blind/mujoco_study.py --seed 1 --count 15 --out runs/mujoco

Case i holds kind i of `mujoco_machines.KINDS`, with a size drawn by the seed. An answer is right where the effects are
among what was added; what else was added is printed beside them. `declared` counts intervals of the declared physics.
"""

from __future__ import annotations

import mujoco_machines as machines
from study import Json, answers, holds, in_turn, judged, options, table, written


def case(kind: str, seed: int) -> Json:
    plant, _ = machines.KINDS[kind]
    system = "cartpole" if plant is machines.CartOnRail else "quadrotor"
    truth, _, answer = written(lambda folder: machines.write(kind, seed, folder), system)
    right = set(truth) <= set(answer["added"]) if truth else not answer["added"]
    found = {label: answer["declared"].get(label, {}) for label in plant.values}
    inside = [holds(p, plant.values[label]) for label, p in found.items() if p.get("interval_90")]
    return {**judged(answer, truth, right=right), "declared_inside": [sum(inside), len(inside)]}


def main() -> None:
    kinds = list(machines.KINDS)
    a = options(__doc__, "seed", "out", first=0, count=len(kinds)).parse_args()
    done = answers(a.out, in_turn(a, kinds, case))
    table(done)
    declared = (sum(d.get("declared_inside", (0, 0))[k] for d in done) for k in (0, 1))
    print("intervals of the declared physics that hold:", " of ".join(map(str, declared)))


if __name__ == "__main__":
    main()
