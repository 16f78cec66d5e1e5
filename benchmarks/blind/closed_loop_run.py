"""Diagnose blind closed-loop cases by the command line, and judge the answers by the truth.

    python benchmarks/blind/closed_loop.py --seed 1 --out loop/
    python benchmarks/blind/closed_loop_run.py --cases loop/ --jobs 2
    python benchmarks/blind/closed_loop_run.py --cases loop/ --judge         # the table again

Each case is `nsde diagnose system=... data=csv data.path=... retrain=false` on its files alone. The answer is kept in
`loop/answers/NAME`, so that an interrupted study goes on where it stopped. `--instruments` names the logged sticks as
signals from outside the loop (`data.instruments=[...]`).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))
from study import held

GAINS = ("thrust_gain", "roll_gain", "pitch_gain", "yaw_gain")
MOVES = 1.1
"""Ratio of a channel's residual before and after from which on an effect counts as visible."""
Json = dict[str, Any]


def diagnose(folder: Path, name: str, limit: float, instruments: bool, further: Sequence[str]) -> str:
    """Diagnose one case in a process of its own; returns what became of it."""
    truth = json.loads((folder / "truth" / f"{name}.json").read_text(encoding="utf-8"))
    out = folder / "answers" / name
    words = [
        *(sys.executable, "-m", "nsde_torch.cli", "diagnose", f"system={truth['system']}", "data=csv"),
        *(f"data.path={folder / 'data' / name}", f"out_dir={out}", "retrain=false", "threads=1", *further),
    ]
    if instruments and truth["exogenous"]:
        words.append(f"data.instruments=[{','.join(truth['exogenous'])}]")
    out.parent.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    status = "done"
    with (out.parent / f"{name}.log").open("w") as log:
        try:
            env = {**os.environ, "OMP_NUM_THREADS": "1"}
            code = subprocess.run(words, stdout=log, stderr=log, env=env, timeout=limit).returncode
            status = "done" if code == 0 else "failed"
        except subprocess.TimeoutExpired:
            status = "too long"
    answer = {"status": status, "seconds": round(time.perf_counter() - started, 1), "command": words[3:]}
    (out.parent / f"{name}.json").write_text(json.dumps(answer, indent=1), encoding="utf-8")
    return status


def judge(truth: Mapping[str, Any], answer: Mapping[str, Any], found: Mapping[str, Any] | None) -> Json:
    """What became of a case.

    Args:
        truth: Its truth.
        answer: Status and time of its diagnosis.
        found: Its `diagnosis.json`; None where there is none.
    """
    true = next(iter(truth["effects"]), "")
    out: Json = {k: truth[k] for k in ("system", "regime", "sticks")}
    out |= {"true": true, "status": answer["status"], "seconds": answer["seconds"]}
    if found is None:
        return out
    added = found["added"]
    own = [f for f in found["findings"] if f["name"] == true]
    ties = [t["effects"] for t in found["ties"] if t["effects"][0] in added]
    out |= {
        "verdict": found["verdict"],
        "added": added,
        "named": true in added,
        "first": bool(added) and added[0] == true,
        "alone": added == [true] if true else not added,
        "tied": any(true in tie for tie in ties),
        "tie": next((tie for tie in ties if true in tie), []),
        "lead": bool(own and own[0]["lead"]),
        "lead_reason": (own[0].get("lead_reason") or "") if own else "",
    }
    cuts = {
        k: r["before"] / r["after"]
        for k, r in found["residual"].items()
        if isinstance(r, dict) and r.get("after")
    }
    out["moves"] = max(cuts.values(), default=1.0) if true else None
    out["inside"], out["intervals"] = held(truth["effects"], found["parameters"]) if out["named"] else (0, 0)
    out["gains"] = {}
    for name in GAINS:
        said = found["declared_parameters"].get(name)
        if said and said.get("value"):
            value, interval = said["value"], said.get("interval_90")
            out["gains"][name] = {
                "ratio": value / truth["declared"][name],
                "held": None if not interval else bool(interval[0] <= truth["declared"][name] <= interval[1]),
                "half_width": None
                if not interval
                else 0.5 * (interval[1] - interval[0]) / truth["declared"][name],
            }
    return out


def table(judged: Mapping[str, Json]) -> str:
    """Shares by regime, gains by regime and sticks, and every case, as Markdown."""
    every = list(judged.values())
    regimes = sorted({j["regime"] for j in every})
    lines = ["| | all | " + " | ".join(regimes) + " |", "|---" * (2 + len(regimes)) + "|"]

    def row(what: str, cases: Sequence[Json], key: Any) -> None:
        cells = []
        for regime in ("all", *regimes):
            some = [j for j in cases if regime in ("all", j["regime"]) and key(j) is not None]
            cells.append(f"{sum(bool(key(j)) for j in some)} of {len(some)}" if some else "")
        lines.append(f"| {what} | " + " | ".join(cells) + " |")

    done = [j for j in every if "verdict" in j]
    singles, nulls = [j for j in done if j["true"]], [j for j in done if not j["true"]]
    row("diagnosed", every, lambda j: "verdict" in j)
    row("single effects: named", singles, lambda j: j["named"])
    row("named or tied", singles, lambda j: j["named"] or j["tied"])
    row("named first", singles, lambda j: j["first"])
    row("named, and nothing else", singles, lambda j: j["alone"])
    row("named, that cut a residual by 10 %: no lead", singles, _no_lead)
    row("nothing missing: silent", nulls, lambda j: j["verdict"] == "no_effect")
    cells = []
    for regime in ("all", *regimes):
        some = [j for j in singles if regime in ("all", j["regime"])]
        total = sum(j["intervals"] for j in some)
        cells.append(f"{sum(j['inside'] for j in some)} of {total}" if total else "")
    lines.append("| 90 % intervals of effects that hold | " + " | ".join(cells) + " |")
    seconds = sorted(j["seconds"] for j in every)
    if seconds:
        lines.append(f"| seconds, median (longest) | {seconds[len(seconds) // 2]:.0f} ({seconds[-1]:.0f}) |")
    lines += ["", "| gains found over true, mean (range); intervals that hold | " + " | ".join(GAINS) + " |"]
    lines.append("|---" * (1 + len(GAINS)) + "|")
    for regime in regimes:
        for logged in (True, False):
            some = [j for j in done if j["regime"] == regime and j["sticks"] == logged]
            if some:
                cells = [_gain([j["gains"][g] for j in some if g in j["gains"]]) for g in GAINS]
                words = "sticks logged" if logged else "no sticks"
                lines.append(f"| {regime}, {words}, {len(some)} cases | " + " | ".join(cells) + " |")
    lines += [
        "",
        "| case | system | regime | sticks | true | answer | verdict | lead | cut | s |",
        "|---" * 10 + "|",
    ]
    for name, j in sorted(judged.items()):
        cut = f"x{j['moves']:.2f}" if j.get("moves") else ""
        tie = f" (tie: {', '.join(j['tie'])})" if j.get("tie") else ""
        said = (", ".join(j.get("added", [])) or "nothing") + tie
        lead = j.get("lead_reason", "") if j.get("lead") else ""
        cells = [name, j["system"], j["regime"], "yes" if j["sticks"] else "no", j["true"] or "nothing", said]
        lines.append(
            "| "
            + " | ".join([*cells, j.get("verdict", j["status"]), lead, cut, f"{j['seconds']:.0f}"])
            + " |"
        )
    return "\n".join(lines) + "\n"


def _no_lead(j: Json) -> bool | None:
    return not j["lead"] if j["named"] and j["moves"] >= MOVES else None


def _gain(found: Sequence[Json]) -> str:
    if not found:
        return ""
    ratios = [f["ratio"] for f in found]
    held = [f["held"] for f in found if f["held"] is not None]
    return f"{sum(ratios) / len(ratios):.3f} ({min(ratios):.2f} to {max(ratios):.2f}); {sum(held)} of {len(held)}"


def judge_all(folder: Path) -> str:
    """Judge every case that has an answer; writes `judged.json` and `table.md`."""
    judged = {}
    for path in sorted((folder / "answers").glob("*.json")):
        result = folder / "answers" / path.stem / "diagnosis.json"
        found = json.loads(result.read_text(encoding="utf-8")) if result.is_file() else None
        truth = json.loads((folder / "truth" / path.name).read_text(encoding="utf-8"))
        judged[path.stem] = judge(truth, json.loads(path.read_text(encoding="utf-8")), found)
    text = table(judged)
    (folder / "judged.json").write_text(json.dumps(judged, indent=1), encoding="utf-8")
    (folder / "table.md").write_text(text, encoding="utf-8")
    return text


def main() -> None:
    """Answer the cases that have no answer yet, then judge all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", type=Path, required=True, help="folder of closed_loop.py")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time, one thread each")
    parser.add_argument("--limit", type=float, default=600.0, help="longest time of one diagnosis [s]")
    parser.add_argument("--names", nargs="+", default=None, help="these cases alone")
    parser.add_argument("--instruments", action="store_true", help="name logged sticks as instruments")
    parser.add_argument("--judge", action="store_true", help="diagnose nothing")
    parser.add_argument("overrides", nargs="*", help="further overrides of nsde diagnose")
    given = parser.parse_args()
    folder = given.cases.resolve()
    names = [
        p.stem
        for p in sorted((folder / "truth").glob("*.json"))
        if given.names is None or p.stem in given.names
    ]
    todo = [] if given.judge else [n for n in names if not (folder / "answers" / f"{n}.json").is_file()]
    started = time.perf_counter()
    with ThreadPoolExecutor(given.jobs) as pool:

        def one(name: str) -> tuple[str, str]:
            return name, diagnose(folder, name, given.limit, given.instruments, given.overrides)

        for k, (name, status) in enumerate(pool.map(one, todo), start=1):
            print(f"{name} {status} ({k} of {len(todo)}, {time.perf_counter() - started:.0f} s)", flush=True)
    print(judge_all(folder))


if __name__ == "__main__":
    main()
