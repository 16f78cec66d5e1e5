"""Blind cases whose states went through a smoother before they were logged: are the same effects named?

    python benchmarks/blind/generate.py --seed 1 --count 300 --out blind/
    python benchmarks/blind/smoothed.py --cases blind/ --out smooth/ --seed 5
    python benchmarks/blind/run.py --cases blind/ --jobs 2
    python benchmarks/blind/run.py --cases smooth/ --jobs 2
    python benchmarks/blind/smoothed.py --cases blind/ --out smooth/ --judge

Each case of one effect or none gets a smoother of SciPy (`bench_smoothed_states.FILTERS`), with a cut-off between 2 and
20 Hz, over all of its states; every second flight over positions and velocities alone, as motion capture has them.
`--judge` holds the answers beside those on the raw logs (leads in brackets). Flights of `closed_loop.py` are smoothed
in the same way, diagnosed and judged by `closed_loop_run.py --cases smooth/`.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
from study import Json, answered, holds, labelled, markdown, options, read_json, save, write_json

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


def _sure(answer: Json) -> list[str]:
    """What is named and is no lead."""
    leads = {f["name"] for f in answer["findings"] if f["lead"]}
    return [name for name in answer["added"] if name not in leads]


def _right(truth: Json, answer: Json) -> bool:
    return sorted(answer["added"]) == sorted(truth["effects"])


def _wrong(truth: Json, answer: Json) -> list[str]:
    """What is named for sure beyond the truth, and is no member of a tie with it."""
    tied = {
        n for t in answer.get("ties", []) if set(t["effects"]) & set(truth["effects"]) for n in t["effects"]
    }
    return [n for n in _sure(answer) if n not in truth["effects"] and n not in tied]


def _off(truth: Json, answer: Json) -> list[str]:
    """Parameters of the true effects that are wrong by 5 % and more, and whose intervals do not hold."""
    out = []
    for label, v in labelled({effect: of["parameters"] for effect, of in truth["effects"].items()}):
        said = answer.get("parameters", {}).get(label)
        if said and said["interval_90"] and abs(said["value"] - v) > 0.05 * abs(v) and not holds(said, v):
            out.append(label)
    return out


def judge(cases: Path, out: Path) -> str:
    """A table of raw and smoothed answers."""
    rows = []
    same = named = raw_named = silent = nulls = 0
    wrong: list[str] = []
    for name, truth, answer in answered(out):
        raw_path = cases / "answers" / f"{name}.json"
        if not raw_path.is_file():
            continue
        key, raw = make_system(truth["system"]).effect_key, read_json(raw_path)
        truth["effects"] = {key(effect): held for effect, held in truth["effects"].items()}
        for one in (raw, answer):
            one["added"] = [key(effect) for effect in one["added"]]
            one["findings"] = [{**f, "name": key(f["name"])} for f in one["findings"]]
        if truth["effects"]:
            raw_named += _right(truth, raw)
            named += _right(truth, raw) and _right(truth, answer)
        else:
            nulls += raw["verdict"] == "no_effect"
            silent += raw["verdict"] == "no_effect" == answer["verdict"]
        same += raw["added"] == answer["added"]
        off = _off(truth, answer)
        if _wrong(truth, answer) or off:
            wrong.append(name)
        told = [
            ", ".join(n if n in _sure(a) else f"({n})" for n in a["added"]) or a["verdict"]
            for a in (raw, answer)
        ]
        true = ", ".join(truth["effects"]) or "nothing"
        through = f"{truth['smoother']['name']} {truth['smoother']['cut_hz']:.1f} Hz"
        rows.append((name, truth["system"], true, through, *told, ", ".join(off)))
    head = ("case", "system", "true", "smoother", "raw", "smoothed", "wrong values")
    said = (
        f"{len(rows)} cases; {same} with the same answer. Of {raw_named} effects that the raw log names alone, {named} "
        f"are named alone behind the smoother; of {nulls} silent nulls {silent} stay silent. Something found for "
        f"sure (no lead) that is not there, or a value off by 5 % outside its interval: {len(wrong)} "
        f"({', '.join(wrong)})"
    )
    return "\n".join([*markdown(head, rows), "", said])


def main() -> None:
    given = options(__doc__, "cases", "out", seed=5, judge=False).parse_args()
    if given.judge:
        print(judge(given.cases, given.out))
    else:
        print(f"{smooth(given.cases, given.out, given.seed)} cases in {given.out}")
        shutil.rmtree(given.out / "answers", ignore_errors=True)


if __name__ == "__main__":
    main()
