"""A ledger of rules that rewrite an outcome: in which cases of the corpus each fires, and what it does there.

    python benchmarks/blind/ledger.py fires --out runs/ledger          # every case once, each rule watched
    python benchmarks/blind/ledger.py without --out runs/ledger        # again without each rule, where it fires
    python benchmarks/blind/ledger.py table --out runs/ledger

The first pass says in which cases a rule (`ledger_rules`) fires. The second one diagnoses these again with that rule
switched off, at most `--most` of a rule and until an answer gets worse, and compares the answers. Each outcome is a
file of its own, so that an interrupted pass goes on where it stopped; a case runs in a process of its own, so that none
knows what another one registered.

An answer is better than another one that is right where the other is not; of two that are alike in this, one that is
sure of fewer wrong effects, that names fewer wrong ones, that is sure of more true ones, whose intervals miss fewer.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))

import broken_logs
import closed_loop
import closed_loop_run
import corpus
import generate
import laws
import loop_flight
import odd_springs
import position_only
import run
import smoothed
import two_frictions
import two_joints
from ledger_rules import RULES, counted, without

Json = dict[str, Any]


def _generated(system: str, seed: int, count: int, smooth: bool = False) -> dict[str, Callable[[], Json]]:
    """Cases of `generate.py`, each written, diagnosed and judged; or those of one effect or none behind a smoother."""

    def answer(case: generate.Case, number: int) -> Json:
        with tempfile.TemporaryDirectory() as raw, tempfile.TemporaryDirectory() as behind:
            generate.write(case, raw)
            if smooth:
                smoothed.smooth(Path(raw), Path(behind), number)
            folder = Path(behind if smooth else raw)
            found = run.diagnose_case(folder, case.name)
            truth = json.loads((folder / "truth" / f"{case.name}.json").read_text(encoding="utf-8"))
        judged = run.judge(truth, found)
        return {**corpus.verdict(found, judged), "truth": judged["true"]}

    some = [
        c for c in generate.cases(seed, count, systems=(system,)) if not smooth or c.kind in smoothed.KINDS
    ]
    return {case.name: partial(answer, case, number) for number, case in enumerate(some)}


def _studied(case: Callable[..., Json], seed: int, count: int, **given: Any) -> dict[str, Callable[[], Json]]:
    """Cases of a study that makes and judges each in one function."""

    def answer(i: int) -> Json:
        found = case(seed, i, **given)
        if case is two_joints.case:
            found["right"] = two_joints.right(found)
        if case is position_only.case:
            found["right"] = found["named"]
        return {**corpus.verdict(found, None), "truth": list(found["truth"])}

    return {f"case_{i:03d}": partial(answer, i) for i in range(count)}


def _laws(machine: str, seed: int, count: int) -> dict[str, Callable[[], Json]]:
    """Cases of `laws.py`; the true name is that under which the law was found, where it was."""

    def answer(i: int) -> Json:
        found = laws.case(machine, seed, i)
        right = found["named"] if found["truth"] else not found["added"]
        wrong = {*found["surely_wrong"]}
        true = [n for n in found["sure"] if n not in wrong] if found.get("there") else []
        if found.get("there"):  # a lead may be the law too
            true += [n for n in found["laws"] if n in found["leads"]]
        return {**corpus.verdict({**found, "right": right}, None), "truth": true}

    return {f"case_{i:03d}": partial(answer, i) for i in range(count)}


def _odd_springs(seed: int, count: int) -> dict[str, Callable[[], Json]]:
    """Springs of `flexible_cases.py`, whose law has no short formula: right says so, and is sure of nothing."""

    def answer(i: int) -> Json:
        import nsde_torch

        with tempfile.TemporaryDirectory() as folder:
            law = laws.write("odd_spring", seed, i, Path(folder))
            data = nsde_torch.read(folder, system=laws.SYSTEMS["odd_spring"])
            content = nsde_torch.diagnose(data, system=laws.SYSTEMS["odd_spring"]).content()
        right = content["verdict"] == "no_effect" if law is None else content["verdict"] != "no_effect"
        return {"right": right and not laws.sure(content), "null": law is None, "inside": [0, 0], "truth": []}

    return {f"case_{i:03d}": partial(answer, i) for i in range(count)}


def _flown(seed: int, names: tuple[str, ...], smoother: int | None = None) -> dict[str, Callable[[], Json]]:
    """Closed loops of `closed_loop.py`, as logged or behind a smoother of `smoothed.py`."""

    def answer(case: closed_loop.Case) -> Json:
        with tempfile.TemporaryDirectory() as raw, tempfile.TemporaryDirectory() as behind:
            closed_loop.write(case, loop_flight.fly(closed_loop.flights_of(case)), Path(raw))
            truth = json.loads((Path(raw) / "truth" / f"{case.name}.json").read_text(encoding="utf-8"))
            if smoother is not None:
                smoothed.smooth(Path(raw), Path(behind), smoother)
            content = _content(
                Path(behind if smoother is not None else raw) / "data" / case.name, truth["system"]
            )
        judged = closed_loop_run.judge(truth, {"status": "done", "seconds": 0.0}, content)
        inside = [judged["inside"], judged["intervals"]]
        found = judged["alone"] or (judged["tied"] and judged["named"])
        right = found if truth["effects"] else judged["verdict"] == "no_effect"
        return {
            "right": right,
            "null": not truth["effects"],
            "inside": inside,
            "truth": list(truth["effects"]),
        }

    return {case.name: partial(answer, case) for case in closed_loop.cases(seed) if case.name in names}


def _odd_machines(seed: int, names: tuple[str, ...]) -> dict[str, Callable[[], Json]]:
    """Springs of `odd_springs.py` that stand, or whose encoder or motor has steps: right is sure of nothing wrong."""

    def answer(name: str) -> Json:
        found = odd_springs.diagnosed(name, seed)
        odd_springs.judge(found)
        missed = found["verdict"] == "no_effect" if found["may"] else bool(found["added"])
        true = [n for n in found["added"] if n in found["may"]]
        right = not found["surely wrong"] and not missed
        return {"right": right, "null": not found["may"], "inside": [0, 0], "truth": true}

    return {name.replace(" ", "_"): partial(answer, name) for name in names}


def _late(seed: int, count: int) -> dict[str, Callable[[], Json]]:
    """Springs and carts of `broken_logs.py` of which a sensor or the inputs are shifted in time."""

    def answer(case: broken_logs.Case) -> Json:
        with tempfile.TemporaryDirectory() as folder:
            log, machine = broken_logs.small_log(case, 0)
            true = {"values": machine.values, "effects": machine.effects}
            broken_logs.write(case, log, None, true, Path(folder))
            content = _content(Path(folder) / "data" / case.name, case.system)
        names = list(machine.effects)
        return {
            "right": {*laws.sure(content)} <= {*names},
            "null": not names,
            "inside": [0, 0],
            "truth": names,
        }

    cases = broken_logs.cases(seed, 40 * count)
    some = [c for c in cases if "shifted" in c.fault and not c.regime]
    return {case.name: partial(answer, case) for case in some[:count]}


def _content(folder: Path, system: str) -> Json:
    """`diagnosis.json` of a folder of logs."""
    import nsde_torch

    return nsde_torch.diagnose(nsde_torch.read(folder, system=system), system=system).content()


SETS: dict[str, dict[str, Callable[[], Json]]] = {
    "frictions": _studied(two_frictions.case, 1, 10),
    "positions": _studied(position_only.case, 32, 4, full=False),
    "positions with rates": _studied(position_only.case, 32, 4, full=True),
    "joints": _studied(two_joints.case, 202, 5),
    "laws of springs": _laws("spring", 3001, 10),
    "odd springs": _odd_springs(8601, 4),
    "springs": _generated("mass_spring_damper", 8123, 12),
    "carts": _generated("cartpole", 8123, 8),
    "smoothed springs": _generated("mass_spring_damper", 8123, 10, smooth=True),
    "smoothed carts": _generated("cartpole", 8123, 8, smooth=True),
    "late": _late(8123, 6),
    "standing": _odd_machines(1, ("sticks", "nothing", "levels", "coarse encoder", "slew", "three")),
    "closed loops": _flown(77, ("case_01", "case_05", "case_06", "case_07", "case_11", "case_15", "case_18")),
    "smoothed loops": _flown(77, ("case_01", "case_07", "case_15"), smoother=5),
}
"""Sets of `corpus.py` by its seeds; springs without a formula; machines that stand; closed loops; smoothers; late logs.

Each answer has `right`, `null`, `inside` and the true names.
"""


def outcome(set_name: str, case: str, inside: Callable[[], AbstractContextManager[None]]) -> Json:
    """Diagnose a case, with rules watched or switched off, and judge it.

    Answers are judged by their names and intervals: an oracle that a study asks beside it is not worked out.

    Args:
        set_name: One of `SETS`.
        case: Name of the case.
        inside: Enters what the diagnosis runs in.
    """
    import torch

    import nsde_torch.api.diagnosing as api
    from nsde_torch.diagnosis import pipeline

    torch.set_num_threads(1)
    original, first, diagnosed = pipeline.diagnose, list[Json](), list[Any]()

    def diagnose(*args: Any, **kwargs: Any) -> Any:
        if diagnosed:
            return diagnosed[0]
        started = time.process_time()
        with inside():
            found = original(*args, **kwargs)
            content = found.content()
        sure = laws.sure(content)
        leads = [f["name"] for f in content["findings"] if f["lead"]]
        seconds = time.process_time() - started
        first.append({**corpus.summary(content), "leads": leads, "sure": sure, "seconds": seconds})
        diagnosed.append(found)
        return found

    pipeline.diagnose = api.diagnose_runs = diagnose
    judged = SETS[set_name][case]()
    return {**first[0], **judged}


def worth(answer: Json) -> tuple[int, ...]:
    """What answers are compared by, the most important first; larger is better."""
    true = {*answer["truth"]}
    tied = {
        name for tie in answer["ties"] for name in tie if not true.isdisjoint(" + ".join(tie).split(" + "))
    }
    return (
        int(answer["right"]),
        -sum(name not in true for name in answer["sure"]),
        -sum(name not in true | tied for name in answer["added"]),
        sum(name in true for name in answer["sure"]),
        answer["inside"][0] - answer["inside"][1],
    )


def compared(before: Json, after: Json) -> tuple[str, list[str]]:
    """Whether an answer without a rule is better, worse or the same, and what differs."""
    said = corpus.changes(before, after)
    if before["leads"] != after["leads"]:
        said.append(f"leads: {before['leads']} -> {after['leads']}")
    one, two = worth(before), worth(after)
    if one == two:
        return ("same" if not said else "other"), said
    return ("better" if two > one else "worse"), said


def _write(path: Path, set_name: str, case: str, rule: str | None) -> None:
    fired: dict[str, int] = {}
    inside = partial(counted, fired) if rule is None else partial(without, _rule(rule))
    try:
        found = outcome(set_name, case, inside)
    except Exception as error:  # without a rule a diagnosis may end
        found = {"error": repr(error)}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**found, "fired": fired}, indent=1, default=float), encoding="utf-8")


def _rule(name: str) -> Any:
    return next(rule for rule in RULES if rule.name == name)


def _in_a_process(path: Path, set_name: str, case: str, rule: str | None) -> Json:
    if not path.is_file():
        made = multiprocessing.get_context("fork").Process(target=_write, args=(path, set_name, case, rule))
        made.start()
        made.join()
        found = json.loads(path.read_text(encoding="utf-8"))
        print(
            rule or "all rules", set_name, case, found.get("error") or f"{found['seconds']:.0f} s", flush=True
        )
    return dict(json.loads(path.read_text(encoding="utf-8")))


def _path(out: Path, rule: str | None, set_name: str, case: str) -> Path:
    folder = "all" if rule is None else "without " + rule
    return out / folder.replace(" ", "_").replace(":", "") / f"{set_name.replace(' ', '_')}-{case}.json"


def fires(out: Path, sets: list[str]) -> dict[tuple[str, str], Json]:
    """Every case of some sets once, each rule watched."""
    import nsde_torch.diagnosis.pipeline  # noqa: F401  here once, and not in each process

    found = {}
    for k in range(
        max(map(len, SETS.values()))
    ):  # in turn, so that a pass that was cut short has some of each
        for name, cases in SETS.items():
            if name in sets and k < len(cases):
                case = list(cases)[k]
                found[name, case] = _in_a_process(_path(out, None, name, case), name, case, None)
    return found


def where(rule: str, found: dict[tuple[str, str], Json]) -> list[tuple[str, str]]:
    """Cases in which a rule fires, what takes least time first."""
    keys = [key for key in found if rule in found[key]["fired"]]
    return sorted(keys, key=lambda key: float(found[key]["seconds"]))


def again(out: Path, found: dict[tuple[str, str], Json], most: int, rules: list[str], minutes: float) -> None:
    """Cases again without each rule, where it fires, until one gets worse; rules that fire in few cases first."""
    ends = time.monotonic() + 60.0 * minutes
    names = [rule.name for rule in RULES if not rules or rule.name in rules]
    for name in sorted(names, key=lambda rule: len(where(rule, found))):
        for key in where(name, found)[:most]:
            if time.monotonic() > ends:
                return
            other = _in_a_process(_path(out, name, *key), *key, name)
            if _judged(found[key], other)[0] == "worse":
                break


def _judged(before: Json, after: Json) -> tuple[str, list[str]]:
    return ("worse", [after["error"]]) if "error" in after else compared(before, after)


def table(out: Path, found: dict[tuple[str, str], Json]) -> list[str]:
    """One row a rule, as Markdown, and the answers that differ."""
    rows = [
        "| rule | fires in | without it: better / worse / other / same | cases that get worse |",
        "|---|---|---|---|",
    ]
    details = []
    for rule in RULES:
        counts, worse = dict.fromkeys(("better", "worse", "other", "same"), 0), []
        for key in where(rule.name, found):
            path = _path(out, rule.name, *key)
            if not path.is_file():
                continue
            other = json.loads(path.read_text(encoding="utf-8"))
            what, said = _judged(found[key], other)
            counts[what] += 1
            worse += [" ".join(key)] if what == "worse" else []
            details += [f"{rule.name}: {' '.join(key)}: {what}: {line}" for line in said if what != "same"]
        fired, tried = len(where(rule.name, found)), " / ".join(map(str, counts.values()))
        rows.append(f"| `{rule.name}`: {rule.purpose} | {fired} | {tried} | {', '.join(worse)} |")
    return [*rows, "", *details]


def main() -> None:
    """One of the passes, or the table of what they found."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=("fires", "without", "table"))
    parser.add_argument("--out", type=Path, required=True, help="folder of the outcomes")
    parser.add_argument("--most", type=int, default=6, help="most cases in which a rule is switched off")
    parser.add_argument(
        "--minutes", type=float, default=600.0, help="time after which no further case is begun"
    )
    parser.add_argument(
        "--sets", nargs="*", choices=list(SETS), default=list(SETS), help="some of the sets alone"
    )
    parser.add_argument("--rules", nargs="*", default=[], help="some of the rules alone")
    a = parser.parse_args()
    found = fires(a.out, a.sets)
    if a.what == "without":
        again(a.out, found, a.most, a.rules, a.minutes)
    if a.what == "table":
        print("\n".join(table(a.out, found)))


if __name__ == "__main__":
    main()
