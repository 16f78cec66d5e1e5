"""Diagnose blind closed-loop cases, and judge the answers by the truth.

    python benchmarks/blind/closed_loop.py --seed 1 --out loop/
    python benchmarks/blind/closed_loop_run.py --cases loop/ --jobs 2
    python benchmarks/blind/closed_loop_run.py --cases loop/ --judge         # the table again

Each case is diagnosed from its files alone. The answer is kept in `loop/answers/NAME.json`, so that an interrupted
study goes on where it stopped. `--instruments` names the logged sticks as signals from outside the loop.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from study import (
    Json,
    answered,
    diagnosed,
    held,
    holds,
    kept,
    markdown,
    missing,
    options,
    pooled,
    report,
    shares,
    truth_of,
)

GAINS = ("thrust_gain", "roll_gain", "pitch_gain", "yaw_gain")
MOVES = 1.1
"""Ratio of a channel's residual before and after from which on an effect counts as visible."""


def diagnose(instruments: bool, folder: Path, name: str) -> Json:
    truth = truth_of(folder, name)
    sticks = truth["exogenous"] if instruments else ()
    found, answer = diagnosed(folder / "data" / name, truth["system"], instruments=sticks)
    return {**found.content(), "seconds": answer["seconds"]}


def judge(truth: Mapping[str, Any], found: Mapping[str, Any]) -> Json:
    """What became of a case, by its truth and what the diagnosis says, or the error in which it ended."""
    true = next(iter(truth["effects"]), "")
    out: Json = {k: truth[k] for k in ("system", "regime", "sticks")}
    out |= {"true": true, "verdict": found["verdict"], "seconds": found["seconds"]}
    if "error" in found:
        return out
    added = found["added"]
    own = next((f for f in found["findings"] if f["name"] == true), {})
    ties = [t["effects"] for t in found["ties"] if t["effects"][0] in added]
    out |= {
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
    done = [j for j in every if "added" in j]
    singles, nulls = [j for j in done if j["true"]], [j for j in done if not j["true"]]
    visible = [j for j in singles if j["named"] and j["moves"] >= MOVES]
    asked = [
        ("diagnosed", every, lambda j: "added" in j),
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
        cases.append((*about, said, j["verdict"], lead, cut, f"{j['seconds']:.0f}"))
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
    parser.add_argument("--instruments", action="store_true", help="name logged sticks as instruments")
    given = parser.parse_args()
    todo = [] if given.judge else missing(given.cases, "answers", given.names)
    make = partial(diagnose, given.instruments)
    pooled(given.jobs, {name: partial(kept, given.cases, name, make) for name in todo})
    judged = {name: judge(truth, answer) for name, truth, answer in answered(given.cases)}
    report(given.cases, judged, table(judged))


if __name__ == "__main__":
    main()
