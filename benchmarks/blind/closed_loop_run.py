"""Diagnose blind closed-loop cases by the command line, and judge the answers by the truth.

    python benchmarks/blind/closed_loop.py --seed 1 --out loop/
    python benchmarks/blind/closed_loop_run.py --cases loop/ --jobs 2
    python benchmarks/blind/closed_loop_run.py --cases loop/ --judge         # the table again

Each case is `nsde diagnose system=... data=csv data.path=... retrain=false` on its files alone. The answer is kept in
`loop/answers/NAME`, so that an interrupted study goes on where it stopped. `--instruments` names the logged sticks as
signals from outside the loop (`data.instruments=[...]`).
"""

import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from study import (
    Json,
    answered,
    held,
    holds,
    markdown,
    missing,
    options,
    pooled,
    read_json,
    shares,
    truth_of,
    write_json,
)

GAINS = ("thrust_gain", "roll_gain", "pitch_gain", "yaw_gain")
MOVES = 1.1
"""Ratio of a channel's residual before and after from which on an effect counts as visible."""


def diagnose(folder: Path, name: str, limit: float, instruments: bool, further: Sequence[str]) -> str:
    """Diagnose one case in a process of its own; returns what became of it."""
    truth, out = truth_of(folder, name), folder / "answers" / name
    words = [
        *("-m", "nsde_torch.cli", "diagnose", f"system={truth['system']}", "data=csv", "retrain=false"),
        *(f"data.path={folder / 'data' / name}", f"out_dir={out}", "threads=1", *further),
    ]
    if instruments and truth["exogenous"]:
        words.append(f"data.instruments=[{','.join(truth['exogenous'])}]")
    out.parent.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    with (out.parent / f"{name}.log").open("w") as log:
        try:
            done = subprocess.run([sys.executable, *words], stdout=log, stderr=log, timeout=limit)
            status = "done" if done.returncode == 0 else "failed"
        except subprocess.TimeoutExpired:
            status = "too long"
    seconds = round(time.perf_counter() - started, 1)
    write_json(out.parent / f"{name}.json", {"status": status, "seconds": seconds, "command": words[2:]})
    return status


def judge(truth: Mapping[str, Any], answer: Mapping[str, Any], found: Mapping[str, Any] | None) -> Json:
    """What became of a case, by its truth, the status and time of its diagnosis, and its `diagnosis.json`, if any."""
    true = next(iter(truth["effects"]), "")
    out: Json = {k: truth[k] for k in ("system", "regime", "sticks")}
    out |= {"true": true, "status": answer["status"], "seconds": answer["seconds"]}
    if found is None:
        return out
    added = found["added"]
    own = next((f for f in found["findings"] if f["name"] == true), {})
    ties = [t["effects"] for t in found["ties"] if t["effects"][0] in added]
    out |= {
        "verdict": found["verdict"],
        "added": added,
        "named": true in added,
        "first": added[:1] == [true],
        "alone": added == [true] if true else not added,
        "tie": next((tie for tie in ties if true in tie), []),
        "lead": bool(own.get("lead")),
        "lead_reason": own.get("lead_reason") or "",
    }
    out["tied"] = bool(out["tie"])
    residuals = [r for r in found["residual"].values() if isinstance(r, dict) and r.get("after")]
    out["moves"] = max((r["before"] / r["after"] for r in residuals), default=1.0) if true else None
    out["inside"] = held(truth["effects"], found["parameters"]) if out["named"] else [0, 0]
    out["gains"] = {}
    for name in GAINS:
        said, gain = found["declared_parameters"].get(name), truth["declared"][name]
        if said and said.get("value"):
            ends = said.get("interval_90")
            inside = holds({"interval_90": ends}, gain) if ends else None
            out["gains"][name] = {"ratio": said["value"] / gain, "held": inside}
    return out


def table(judged: Mapping[str, Json]) -> str:
    """Shares by regime, gains by regime and sticks, and every case, as Markdown."""
    every = list(judged.values())
    done = [j for j in every if "verdict" in j]
    singles, nulls = [j for j in done if j["true"]], [j for j in done if not j["true"]]
    visible = [j for j in singles if j["named"] and j["moves"] >= MOVES]
    asked = [
        ("diagnosed", every, lambda j: "verdict" in j),
        ("single effects: named", singles, lambda j: j["named"]),
        ("named or tied", singles, lambda j: j["named"] or j["tied"]),
        ("named first", singles, lambda j: j["first"]),
        ("named, and nothing else", singles, lambda j: j["alone"]),
        ("named, that cut a residual by 10 %: no lead", visible, lambda j: not j["lead"]),
        ("nothing missing: silent", nulls, lambda j: j["verdict"] == "no_effect"),
        ("90 % intervals of effects that hold", singles, lambda j: j["inside"]),
    ]
    seconds = sorted(j["seconds"] for j in every) or [0.0]
    spent = f"seconds, median (longest): {seconds[len(seconds) // 2]:.0f} ({seconds[-1]:.0f})"
    gains = []
    for regime, logged in product(sorted({j["regime"] for j in done}), (True, False)):
        some = [j for j in done if j["regime"] == regime and j["sticks"] == logged]
        if some:
            words = f"{regime}, {'sticks logged' if logged else 'no sticks'}, {len(some)} cases"
            gains.append([words, *(_gain([j["gains"][g] for j in some if g in j["gains"]]) for g in GAINS)])
    cases = []
    for name, j in sorted(judged.items()):
        tie = f" (tie: {', '.join(j['tie'])})" if j.get("tie") else ""
        said = (", ".join(j.get("added", [])) or "nothing") + tie
        about = name, j["system"], j["regime"], "yes" if j["sticks"] else "no", j["true"] or "nothing"
        lead = j.get("lead_reason", "") if j.get("lead") else ""
        cut = f"x{j['moves']:.2f}" if j.get("moves") else ""
        cases.append((*about, said, j.get("verdict", j["status"]), lead, cut, f"{j['seconds']:.0f}"))
    head = ("case", "system", "regime", "sticks", "true", "answer", "verdict", "lead", "cut", "s")
    of_gains = ("gains found over true, mean (range); intervals that hold", *GAINS)
    parts = shares(asked, "regime"), [spent], markdown(of_gains, gains), markdown(head, cases)
    return "\n\n".join(map("\n".join, parts)) + "\n"


def _gain(found: Sequence[Json]) -> str:
    if not found:
        return ""
    ratios = [f["ratio"] for f in found]
    held = [f["held"] for f in found if f["held"] is not None]
    return f"{sum(ratios) / len(ratios):.3f} ({min(ratios):.2f} to {max(ratios):.2f}); {sum(held)} of {len(held)}"


def main() -> None:
    parser = options(__doc__, "cases", jobs=1, names=None, judge=False)
    parser.add_argument("--limit", type=float, default=600.0, help="longest time of one diagnosis [s]")
    parser.add_argument("--instruments", action="store_true", help="name logged sticks as instruments")
    parser.add_argument("overrides", nargs="*", help="further overrides of nsde diagnose")
    given = parser.parse_args()
    folder = given.cases.resolve()
    todo = [] if given.judge else missing(folder, "answers", given.names)
    how = given.limit, given.instruments, given.overrides
    pooled(given.jobs, {name: partial(diagnose, folder, name, *how) for name in todo})
    judged = {}
    for name, truth, answer in answered(folder):
        result = folder / "answers" / name / "diagnosis.json"
        judged[name] = judge(truth, answer, read_json(result) if result.is_file() else None)
    write_json(folder / "judged.json", judged)
    (folder / "table.md").write_text(table(judged), encoding="utf-8")
    print(table(judged))


if __name__ == "__main__":
    main()
