"""Blind cases whose states went through a smoother before they were logged: are the same effects named?

    python benchmarks/blind/smoothed.py --cases blind/ --out smooth/ --seed 5       # of generate.py or closed_loop.py
    python benchmarks/blind/smoothed.py --cases blind/ --out smooth/ --judge        # both answered by run.py

Each case of one effect or none gets a smoother of `bench_smoothed_states`, with a cut-off between 2 and 20 Hz, over all
of its states; every second flight over positions and velocities alone, as motion capture has them. `--judge` holds the
answers beside those on the raw logs (leads in brackets).
"""

import shutil
import sys
from pathlib import Path

import numpy as np
from study import Json, answered, holds, labelled, markdown, options, read_json, save, shares, write_json

sys.path.append(str(Path(__file__).resolve().parents[1]))
from bench_smoothed_states import FILTERS

from nsde_torch.systems import make_system

KINDS = ("single", "null")


def smooth(cases: Path, out: Path, seed: int) -> int:
    """Write smoothed copies of the cases; returns how many."""
    rng = np.random.default_rng(seed)
    count = 0
    for path in sorted((cases / "truth").glob("case_*.json")):
        truth = read_json(path)
        if "case" in truth and truth["case"]["kind"] not in KINDS:
            continue
        name = str(rng.choice(list(FILTERS)))
        cut = float(np.exp(rng.uniform(np.log(2.0), np.log(20.0))))
        system = make_system(truth["system"])
        turns = () if system.quaternion is None else system.state_names[system.quaternion.start :]
        spared = turns if count % 2 else ()
        truth["smoother"] = {"name": name, "cut_hz": cut, "spared": spared}
        for file in sorted((cases / "data" / path.stem).glob("*.csv")):
            target = out / "data" / path.stem / file.name
            header = file.read_text(encoding="utf-8").partition("\n")[0].strip().split(",")
            rows = np.loadtxt(file, delimiter=",", skiprows=1)
            states = [header.index(s) for s in system.state_names if s not in spared]
            rows[:, states] = FILTERS[name](rows[:, states], cut, float(np.median(np.diff(rows[:, 0]))))
            if system.quaternion is not None:
                q = [header.index(s) for s in system.state_names[system.quaternion]]
                rows[:, q] /= np.linalg.norm(rows[:, q], axis=1, keepdims=True)
            save(target, header, [rows])
        write_json(out / "truth" / path.name, truth)
        count += 1
    return count


def _wrong(true: Json, answer: Json) -> list[str]:
    """What is named for sure beyond the truth, and is no member of a tie with it."""
    ties = [set(tie["effects"]) for tie in answer["ties"]]
    known = set(true).union(answer["leads"], *(tie for tie in ties if tie & set(true)))
    return [name for name in answer["added"] if name not in known]


def _off(true: Json, answer: Json) -> list[str]:
    """Parameters of the true effects that are wrong by 5 % and more, and whose intervals do not hold."""
    out = []
    for label, v in labelled(true):
        said = answer["parameters"].get(label) or {}
        if said.get("interval_90") and abs(said["value"] - v) > 0.05 * abs(v) and not holds(said, v):
            out.append(label)
    return out


def judge(cases: Path, out: Path) -> str:
    rows, found = [], []
    for name, truth, answer in answered(out):
        raw_path = cases / "answers" / f"{name}.json"
        if not raw_path.is_file():
            continue
        raw, true = read_json(raw_path), {effect: of["parameters"] for effect, of in truth["effects"].items()}
        both, off = (raw, answer), _off(true, answer)
        right = [{*one["added"]} == {*true} and (true or one["verdict"] == "no_effect") for one in both]
        wrong = bool(_wrong(true, answer) or off)
        about = {"system": truth["system"], "null": not true, "same": raw["added"] == answer["added"]}
        found.append({**about, "raw": right[0], "right": right[1], "wrong": wrong})
        names = [[f"({n})" if n in one["leads"] else n for n in one["added"]] for one in both]
        told = [", ".join(some) or one["verdict"] for some, one in zip(names, both, strict=True)]
        through = f"{truth['smoother']['name']} {truth['smoother']['cut_hz']:.1f} Hz"
        rows.append((name, truth["system"], ", ".join(true) or "nothing", through, *told, ", ".join(off)))
    singles, nulls = ([j for j in found if j["raw"] and j["null"] is null] for null in (False, True))
    asked = [
        ("the same answer", found, lambda j: j["same"]),
        ("named alone raw: and behind the smoother", singles, lambda j: j["right"]),
        ("silent raw: and behind the smoother", nulls, lambda j: j["right"]),
        ("sure and not there, or a value off by 5 % outside its interval", found, lambda j: j["wrong"]),
    ]
    head = ("case", "system", "true", "smoother", "raw", "smoothed", "wrong values")
    return "\n".join([*markdown(head, rows), "", *shares(asked, "system")])


def main() -> None:
    given = options(__doc__, "cases", "out", seed=5, judge=False).parse_args()
    if given.judge:
        print(judge(given.cases, given.out))
    else:
        print(f"{smooth(given.cases, given.out, given.seed)} cases in {given.out}")
        shutil.rmtree(given.out / "answers", ignore_errors=True)


if __name__ == "__main__":
    main()
