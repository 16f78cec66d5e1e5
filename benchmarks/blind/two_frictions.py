"""Springs with dry friction and quadratic damping: two undeclared effects of one speed, beside a declared damping.

    python benchmarks/blind/two_frictions.py --seed 1 --count 10 --out runs/two_frictions

An answer is right where both effects are named, or are indistinguishable from what was named; `damping_missed` says
that the interval of the declared damping does not hold the true value.
"""

from pathlib import Path

import numpy as np
from small_machines import Small, columns, run
from study import Json, answers, held, holds, inside, numbered, options, save, tied, written

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
    return {
        **{**answer, "case": i, "truth": truth},
        "right": set(truth) <= {*answer["added"], *tied(answer)},
        "inside": held(truth, answer["parameters"]),
        "damping_missed": bool(damping.get("interval_90")) and not holds(damping, values["b"]),
    }


def line(answer: Json) -> str:
    keys = ("right", "truth", "added", "inside", "damping_missed", "error")
    return f"{answer['case']} { {k: answer.get(k) for k in keys} }"


def main() -> None:
    a = options(__doc__, "seed", "out", first=0, count=10).parse_args()
    wrong = {"right": False, "added": ["error"], "inside": [0, 0], "damping_missed": False}
    done = answers(a.out, numbered(a, case, **wrong), line)
    print(f"both named or indistinguishable: {sum(d['right'] for d in done)} of {len(done)}")
    print("intervals that hold:", inside(done))
    print(f"damping surely missed: {sum(d['damping_missed'] for d in done)}")


if __name__ == "__main__":
    main()
