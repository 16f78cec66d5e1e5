"""The committed blind studies as one corpus: one command, one table, and what a change of the code does to it.

    python benchmarks/blind/corpus.py --out corpus/before
    python benchmarks/blind/corpus.py --out corpus/after --against corpus/before
    python benchmarks/blind/corpus.py --out corpus/before --sets springs joints      # some of the sets
    python benchmarks/blind/corpus.py --out corpus/before --sets recorded \
        --logs "published flights=DATA/hexacopter/trajs.pkl" "strong wind=NEURAL_FLY/custom_figure8_baseline_100wind"

Each set runs in a process of its own on fixed seeds; sets whose outcome is in the folder are not run again. The table
says how many answers are right, how many machines without an undeclared effect stay silent, how many 90 % intervals
of effects hold, the processor time of a case and the largest memory of a process of the set. `--against` lists
the cases whose verdict, effects or ties differ, or a value that moved by more than a tenth of its half-width.

Logs of real machines are a set, too, of those whose place is given (`RECORDED` has their sources). Nobody knows their
truth: right is what earlier diagnoses found and independent evidence supports.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
Json = dict[str, Any]

GENERATED = {
    "springs": "--seed 8123 --count 24 --systems mass_spring_damper",
    "carts": "--seed 8123 --count 24 --systems cartpole",
    "hexacopters": "--seed 8124 --count 4 --systems hexacopter",
}
"""Arguments of `generate.py`; `run.py` diagnoses the cases."""

STUDIES = {
    "joints": ("two_joints.py", "--seed 202 --count 4"),
    "frictions": ("two_frictions.py", "--seed 1 --count 10"),
    "positions": ("position_only.py", "--seed 32 --count 4"),
    "laws of springs": ("laws.py", "--machine spring --seed 3001 --count 8"),
    "laws of carts": ("laws.py", "--machine cart --seed 3001 --count 4"),
}
"""Studies that make and diagnose their cases in one command."""


RECORDED: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "published flights": ("system=hexacopter data=published", ("motor_lag", "thrust_sag", "flapping_moment")),
    "strong wind": (  # aerorobotics/neural-fly, data/experiment, the table in a folder of its own
        "system=quadrotor system.options.yaw_direction=-1",
        ("constant_wind",),
    ),
    "nanobench": ("system=quadrotor data.dt=0.01", ("battery",)),  # syediu/nanobench-iros2026, with a mapping
}
"""Arguments of `nsde diagnose` for each log, and the effects that are expected of it."""


def ran(words: list[str], log: Path) -> tuple[float, float]:
    """Run a script of this folder; its processor seconds, and the largest memory of one of its processes [MB]."""
    with log.open("a", encoding="utf-8") as out:
        env = {**os.environ, "OMP_NUM_THREADS": "1"}
        process = subprocess.Popen([sys.executable, *words], stdout=out, stderr=out, env=env)
        _, status, usage = os.wait4(process.pid, 0)  # what it used, its own processes included
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(words)} ended with {process.returncode}; its output is in {log}")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


def of_logs(logs: Mapping[str, Path], folder: Path, log: Path) -> tuple[float, float]:
    """Diagnose recorded logs, the answers written to a folder; processor seconds and the largest memory [MB]."""
    folder.mkdir(exist_ok=True)
    costs = []
    for name, path in logs.items():
        words, expected = RECORDED[name]
        where = folder.parent / name.replace(" ", "_")
        given = [*words.split(), f"data.path={path}", "retrain=false", f"out_dir={where}"]
        costs.append(ran(["-m", "nsde_torch.cli", "diagnose", *given], log))
        found = json.loads((where / "diagnosis.json").read_text(encoding="utf-8"))
        found |= {"truth": list(expected), "right": set(expected) <= set(found["added"])}
        (folder / f"{where.name}.json").write_text(json.dumps(found), encoding="utf-8")
    return sum(s for s, _ in costs), max(mb for _, mb in costs)


def answered(name: str, out: Path, logs: Mapping[str, Path]) -> Json:
    """Run a set; its cost and its answers, each with `right`, `null` and `inside`."""
    folder = out / name.replace(" ", "_")
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "output.log"
    if name == "recorded":
        answers, judged = folder / "answers", {}
        seconds, memory = of_logs(logs, answers, log)
    elif name in GENERATED:
        cases = ["--out", str(folder)]
        ran([str(HERE / "generate.py"), *GENERATED[name].split(), *cases], log)
        seconds, memory = ran([str(HERE / "run.py"), "--cases", str(folder)], log)
        answers = folder / "answers"
        judged = json.loads((folder / "judged.json").read_text(encoding="utf-8"))
    else:
        script, given = STUDIES[name]
        answers = folder / "answers"
        seconds, memory = ran([str(HERE / script), *given.split(), "--out", str(answers)], log)
        judged = {}
    found = {}
    for path in sorted(answers.glob("*.json")):
        answer = json.loads(path.read_text(encoding="utf-8"))
        found[path.stem] = {**summary(answer), **verdict(answer, judged.get(path.stem))}
    return {"seconds": seconds, "memory_mb": memory, "cases": found}


def summary(answer: Json) -> Json:
    """What two versions of the code are compared by."""
    values = {
        label: [p["value"], p.get("interval_90")] if isinstance(p, dict) else p
        for label, p in answer.get("parameters", {}).items()
    }
    ties = sorted(sorted(tie["effects"]) for tie in answer.get("ties", []))
    return {
        "verdict": answer.get("verdict", "crash"),
        "added": answer["added"],
        "ties": ties,
        "values": values,
    }


def verdict(answer: Json, judged: Json | None) -> Json:
    """Whether an answer is right, whether nothing was undeclared, and intervals of effects that hold, of how many."""
    if judged is not None:
        null = judged["kind"] == "null"
        right = answer["verdict"] == "no_effect" if null else judged["exact"] or judged["in_tie"]
        return {"right": right, "null": null, "inside": [judged["inside"], judged["intervals"]]}
    held = answer.get("held")  # of a law: whether its size and shape are held, where they have intervals
    inside = answer.get("inside") or ([sum(held), len(held)] if isinstance(held, list) else [0, 0])
    right = answer["right"] if "right" in answer else bool(answer.get("named"))
    return {"right": right, "null": not answer.get("truth"), "inside": inside}


def changes(before: Json, after: Json) -> list[str]:
    """What differs between the answers to one case."""
    out = [f"{k}: {before[k]} -> {after[k]}" for k in ("verdict", "added", "ties") if before[k] != after[k]]
    for label in sorted({*before["values"], *after["values"]}):
        if label not in before["values"] or label not in after["values"]:
            continue  # its effect differs, which is said above
        (old, ends), (new, now) = before["values"][label], after["values"][label]
        if (ends is None) != (now is None):
            out.append(f"{label}: interval {ends} -> {now}")
        elif ends and now:
            moved = max(abs(a - b) for a, b in zip((old, *ends), (new, *now), strict=True))
            if moved > 0.05 * (ends[1] - ends[0]):
                out.append(f"{label}: {old:.4g} {ends} -> {new:.4g} {now}")
    return out


def table(sets: dict[str, Json]) -> list[str]:
    """One row a set, as Markdown."""
    lines = [
        "| set | right | nulls silent | intervals that hold | CPU s a case | MB |",
        "|---|---|---|---|---|---|",
    ]
    for name, found in sets.items():
        cases = list(found["cases"].values())
        nulls = [c for c in cases if c["null"]]
        held = [sum(c["inside"][k] for c in cases) for k in (0, 1)]
        cells = (
            f"{sum(c['right'] for c in cases)} of {len(cases)}",
            f"{sum(c['right'] for c in nulls)} of {len(nulls)}",
            f"{held[0]} of {held[1]}",
            f"{found['seconds'] / len(cases):.1f}",
            f"{found['memory_mb']:.0f}",
        )
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return lines


def main() -> None:
    """Run the sets that have no outcome yet, print the table, and compare."""
    names = [*GENERATED, *STUDIES, "recorded"]
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of the answers")
    parser.add_argument("--sets", nargs="*", choices=names, default=names[:-1])
    parser.add_argument(
        "--logs", nargs="+", default=[], metavar="NAME=PATH", help=f"recorded logs: {', '.join(RECORDED)}"
    )
    parser.add_argument("--against", type=Path, help="folder of the answers of other code")
    a = parser.parse_args()
    logs = {name: Path(path).resolve() for name, path in (word.split("=", 1) for word in a.logs)}
    if unknown := logs.keys() - RECORDED.keys():
        parser.error(f"--logs knows {', '.join(RECORDED)}; not {', '.join(sorted(unknown))}")
    if "recorded" in a.sets and not logs:
        parser.error("the set recorded needs --logs NAME=PATH ...")
    sets = {}
    for name in a.sets:
        path = a.out / f"{name.replace(' ', '_')}.json"
        if not path.is_file():
            found = answered(name, a.out, logs)  # the folder exists from here on
            path.write_text(json.dumps(found, indent=1), encoding="utf-8")
        sets[name] = json.loads(path.read_text(encoding="utf-8"))
        print("\n".join(table({name: sets[name]})[-1:]), flush=True)
    print("\n" + "\n".join(table(sets)))
    if a.against is None:
        return
    differ = 0
    for name, found in sets.items():
        other = json.loads((a.against / f"{name.replace(' ', '_')}.json").read_text(encoding="utf-8"))
        for case, answer in found["cases"].items():
            said = changes(other["cases"][case], answer)
            differ += bool(said)
            for line in said:
                print(f"{name} {case}: {line}")
    print(f"{differ} of {sum(len(s['cases']) for s in sets.values())} answers differ")


if __name__ == "__main__":
    main()
