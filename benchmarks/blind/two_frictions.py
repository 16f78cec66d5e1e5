"""Springs with dry friction and quadratic damping: two undeclared effects of one speed, beside a declared damping.

Runs are made by `small_machines`, which shares no code with the package. An answer is right where both effects are
named, or told as indistinguishable from what was named; `damping_missed` says that the interval of the declared
damping is not marked as doubtful and does not hold the true value.

    python benchmarks/blind/two_frictions.py --seed 1 --count 10 --out runs/two_frictions
"""

from __future__ import annotations

import sys
import tempfile
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
from small_machines import STATES, Small, run
from study import Json, answers, options, save

NAMES = {"coulomb": "coulomb_friction", "quadratic": "quadratic_damping"}
RUNS, SECONDS, DT = 4, 8.0, 0.01


def case(seed: int, i: int) -> Json:
    """Make and diagnose one case."""
    import torch

    import nsde_torch

    torch.set_num_threads(1)
    rng = np.random.default_rng([seed, i])
    values = {"k": rng.uniform(2.0, 8.0), "b": 0.5, "g": 1.0}
    sizes = {"coulomb": rng.uniform(0.06, 0.24), "quadratic": rng.uniform(0.14, 0.72)}
    machine = Small(
        "mass_spring_damper", values, {k: {"size": v} for k, v in sizes.items()}, (0.001, 0.003), gust=0.02
    )
    with tempfile.TemporaryDirectory() as folder:
        for k in range(RUNS):
            t, y, u = run(machine, SECONDS, DT, seed=1000 * seed + 10 * i + k)
            names = ("t", *STATES[machine.system], "force")
            save(Path(folder) / f"run_{k}.csv", names, [t + 100.0 * k, y, u], "%.7f")
        data = nsde_torch.read(folder, system=machine.system)
        found = nsde_torch.diagnose(data, system=machine.system).content()
    true = {NAMES[key]: value for key, value in sizes.items()}
    tied = {part for tie in found["ties"] for name in tie["effects"] for part in name.split(" + ")}
    said = [
        found["parameters"].get(f"{name}.{k}", {}) for name, k in zip(true, ("size", "damping"), strict=True)
    ]
    held = [(s["interval_90"], v) for s, v in zip(said, true.values(), strict=True) if s.get("interval_90")]
    damping = found["declared_parameters"]["viscous_friction.damping"]
    interval = damping.get("interval_90")
    return {
        "case": i,
        "truth": true,
        "verdict": found["verdict"],
        "added": found["added"],
        "ties": found["ties"],
        "right": set(true) <= {*found["added"], *tied},
        "parameters": {k: [v["value"], v["interval_90"]] for k, v in found["parameters"].items()},
        "inside": [sum(a <= v <= b for (a, b), v in held), len(held)],
        "damping": [damping.get("value"), interval],
        "damping_missed": bool(interval) and not interval[0] <= values["b"] <= interval[1],
    }


def main() -> None:
    """Diagnoses cases one after another, and counts."""
    a = options("Springs with two frictions of one speed.", count=10).parse_args()

    def line(answer: Json) -> str:
        keys = ("right", "truth", "added", "inside", "damping", "damping_missed", "error")
        return f"{answer['case']} { {k: answer.get(k) for k in keys} }"

    wrong = {"right": False, "added": ["error"], "inside": [0, 0], "damping_missed": False}
    cases = [
        (f"seed_{a.seed}_case_{i:03d}", partial(case, a.seed, i), {"case": i, **wrong})
        for i in range(a.first, a.first + a.count)
    ]
    done = answers(a.out, cases, line)
    print(f"both named or indistinguishable: {sum(d['right'] for d in done)} of {len(done)}")
    print("intervals that hold:", [sum(d["inside"][k] for d in done) for k in (0, 1)])
    print(f"damping surely missed: {sum(d['damping_missed'] for d in done)}")


if __name__ == "__main__":
    main()
