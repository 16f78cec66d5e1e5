"""Springs with dry friction and quadratic damping: two undeclared effects of one speed, beside a declared damping.

    python benchmarks/blind/two_frictions.py --seed 1 --count 10 --out runs/two_frictions

An answer is right where both effects are named, or are indistinguishable from what was named; `damping_missed` says
that the interval of the declared damping does not hold the true value.
"""

from pathlib import Path

import numpy as np
from small_machines import Small, run
from study import Json, answers, columns, holds, judged, numbered, options, save, table, tied, written

SPRING, DAMPING = "mass_spring_damper", "viscous_friction.damping"
RUNS, SECONDS, DT = 4, 8.0, 0.01


def case(seed: int, i: int) -> Json:
    rng = np.random.default_rng([seed, i])
    values = {"k": rng.uniform(2.0, 8.0), "b": 0.5, "g": 1.0}
    dry, quadratic = rng.uniform(0.06, 0.24), rng.uniform(0.14, 0.72)
    effects = {"coulomb": {"size": dry}, "quadratic": {"size": quadratic}}
    machine = Small(SPRING, values, effects, (0.001, 0.003), gust=0.02)

    def write(folder: Path) -> None:
        for k in range(RUNS):
            t, y, u = run(machine, SECONDS, DT, seed=1000 * seed + 10 * i + k)
            save(folder / f"run_{k}.csv", columns(SPRING), [t + 100.0 * k, y, u], "%.7f")

    _, _, answer = written(write, SPRING)
    truth = {"coulomb_friction": {"size": dry}, "quadratic_damping": {"damping": quadratic}}
    damping = answer["declared"][DAMPING]
    missed = bool(damping.get("interval_90")) and not holds(damping, values["b"])
    right = set(truth) <= {*answer["added"], *tied(answer)}
    return {**judged(answer, truth, right=right), "damping_missed": missed}


def main() -> None:
    a = options(__doc__, "seed", "out", first=0, count=10).parse_args()
    table(answers(a.out, numbered(a, case)), also=["damping_missed"])


if __name__ == "__main__":
    main()
