"""Does a diagnosis depend on the units of a log? Answers to blind springs, and to the same ones scaled.

    python benchmarks/blind/generate.py --seed 5601 --count 40 --systems mass_spring_damper cartpole --out blind/
    python benchmarks/blind/run.py --cases blind/
    python benchmarks/blind/units.py --cases blind/ --seconds 100 --out runs/slow

Lengths and forces are multiplied by `--metres`, times by `--seconds`: a machine that is smaller, or slower. The first
values of its parameters stay those of the package, and are then far off.
"""

from functools import partial
from pathlib import Path

import numpy as np
from study import Json, answers, options, read_json, save, truth_of, written


def scaled(cases: Path, name: str, metres: float, seconds: float, out: Path) -> None:
    for path in sorted((cases / "data" / name).glob("*.csv")):
        t, q, v, u = np.loadtxt(path, delimiter=",", skiprows=1).T
        v, u = v / seconds, u / seconds**2
        save(
            out / path.name,
            ("t", "q", "q_dot", "force"),
            [t * seconds, *(metres * x for x in (q, v, u))],
            "%.12g",
        )


def case(cases: Path, name: str, metres: float, seconds: float) -> Json:
    before = read_json(cases / "answers" / f"{name}.json")
    _, _, answer = written(partial(scaled, cases, name, metres, seconds), "mass_spring_damper")
    same = before["verdict"] == answer["verdict"]
    same = same and all({*before[key]} == {*answer[key]} for key in ("added", "leads"))
    return answer | {"before": before["added"] or [before["verdict"]], "same": same}


def main() -> None:
    parser = options(__doc__, "cases", count=14, out=None)
    for name in ("metres", "seconds"):
        parser.add_argument(f"--{name}", type=float, default=1.0, help="times as many in the log")
    a = parser.parse_args()
    names = [path.stem for path in sorted((a.cases / "answers").glob("*.json"))]
    springs = [name for name in names if truth_of(a.cases, name)["system"] == "mass_spring_damper"][: a.count]

    def say(one: Json) -> str:
        said = ", ".join(one["added"]) or one["verdict"]
        return (
            f"{'same' if one['same'] else 'OTHER'}: {', '.join(one['before'])} -> {said} {one['leads'] or ''}"
        )

    done = answers(a.out, [(n, partial(case, a.cases, n, a.metres, a.seconds), {}) for n in springs], say)
    print(f"{sum(d.get('same', False) for d in done)} of {len(done)} answers are the same")


if __name__ == "__main__":
    main()
