"""The blind studies as one corpus: what a change of the code, a rule or a threshold does to their answers.

    python benchmarks/blind/corpus.py run --out corpus/before                       # every case once, rules watched
    python benchmarks/blind/corpus.py run --out corpus/after --against corpus/before
    python benchmarks/blind/corpus.py without --out corpus/before             # again without each rule, where it fires
    python benchmarks/blind/corpus.py rules --out corpus/before                     # the table of that
    python benchmarks/blind/corpus.py thresholds --out corpus/before --sets springs carts --count 5

Seeds are fixed. Each outcome is a file of its own, so that an interrupted pass goes on where it stopped; a case runs in
a process of its own, so that none knows what another one registered. `--against` lists the cases whose verdict, effects
or ties differ, or a value that moved by a tenth of its half-width. `without` diagnoses again the cases in which a rule
(`ledger_rules`) fires with that rule switched off, at most `--most` of a rule and until an answer gets worse;
`thresholds` halves and doubles each number of `Decisions`. What a better answer is says `worth`.
"""

import argparse
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import broken_logs
import closed_loop
import closed_loop_run
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
from study import Json, diagnosed, line, markdown, options, read_json, sure, truth_of, write_json, written

Make = Callable[[], Json]
Found = dict[tuple[str, str], Json]


def _judged(right: bool, truth: Any, inside: list[int] | None = None) -> Json:
    return {"right": bool(right), "null": not truth, "inside": inside or [0, 0], "truth": list(truth or ())}


@contextmanager
def _files(write: Callable[[Path], Any], smoother: int | None) -> Iterator[Path]:
    """A folder with the files of a case, as logged or behind a smoother of `smoothed.py`."""
    with tempfile.TemporaryDirectory() as raw, tempfile.TemporaryDirectory() as behind:
        write(Path(raw))
        if smoother is not None:
            smoothed.smooth(Path(raw), Path(behind), smoother)
        yield Path(raw if smoother is None else behind)


def _generated(system: str, seed: int, count: int, smooth: bool = False) -> dict[str, Make]:
    """Cases of `generate.py`; or those of one effect or none behind a smoother."""

    def answer(case: generate.Case, number: int) -> Json:
        with _files(partial(generate.write, case), number if smooth else None) as folder:
            found, truth = run.diagnose_case(folder, case.name), truth_of(folder, case.name)
        judged = run.judge(truth, found)
        null = judged["kind"] == "null"
        right = found["verdict"] == "no_effect" if null else judged["exact"] or judged["in_tie"]
        return _judged(right, judged["true"], judged["inside"]) | {"null": null}

    every = generate.cases(seed, count, systems=(system,))
    some = [c for c in every if not smooth or c.kind in smoothed.KINDS]
    return {case.name: partial(answer, case, number) for number, case in enumerate(some)}


def _numbered(answer: Callable[[int], Json], count: int) -> dict[str, Make]:
    return {f"case_{i:03d}": partial(answer, i) for i in range(count)}


def _studied(case: Callable[..., Json], seed: int, i: int, **given: Any) -> Json:
    """A case of a study that makes and judges each in one function."""
    found = case(seed, i, **given)
    true = found.get("there", found["truth"])  # of laws the names under which each was found
    return _judged(found["right"], true, found["inside"]) | {"null": not found["truth"]}


def _odd_law(seed: int, i: int) -> Json:
    """A spring of `flexible_cases.py`, whose law has no short formula: right says so, and is sure of nothing."""
    law, _, found = written(lambda folder: laws.write("odd_spring", seed, i, folder), "mass_spring_damper")
    right = (found["verdict"] == "no_effect") == (law is None) and not found["sure"]
    return _judged(right, ()) | {"null": law is None}


def _flown(seed: int, names: tuple[str, ...], smoother: int | None = None) -> dict[str, Make]:
    """Closed loops of `closed_loop.py`."""

    def answer(case: closed_loop.Case) -> Json:
        logged = loop_flight.fly(closed_loop.flights_of(case))
        with _files(partial(closed_loop.write, case, logged), smoother) as folder:
            truth = truth_of(folder, case.name)
            content = diagnosed(folder / "data" / case.name, truth["system"])[0].content()
        judged = closed_loop_run.judge(truth, {**content, "seconds": 0.0})
        right = judged["alone"] or (judged["tied"] and judged["named"])
        right = right if truth["effects"] else judged["verdict"] == "no_effect"
        return _judged(right, truth["effects"], judged["inside"])

    return {case.name: partial(answer, case) for case in closed_loop.cases(seed) if case.name in names}


def _odd_machine(seed: int, name: str) -> Json:
    """A spring of `odd_springs.py` that stands, or whose encoder or motor has steps: right is sure of nothing wrong."""
    found = odd_springs.case(name, seed)
    missed = found["verdict"] == "no_effect" if found["truth"] else bool(found["added"])
    true = [n for n in found["added"] if n in found["truth"]]
    return _judged(not found["wrong"] and not missed, true) | {"null": not found["truth"]}


def _late(seed: int, count: int) -> dict[str, Make]:
    """Springs and carts of `broken_logs.py` of which a sensor or the inputs are shifted in time."""

    def answer(case: broken_logs.Case) -> Json:
        with tempfile.TemporaryDirectory() as folder:
            log, machine = broken_logs.small_log(case, 0)
            broken_logs.write(case, log, None, {}, Path(folder))
            _, found = diagnosed(Path(folder) / "data" / case.name, case.system)
        return _judged({*found["sure"]} <= {*machine.effects}, machine.effects)

    some = [c for c in broken_logs.cases(seed, 40 * count) if "shifted" in c.fault and not c.regime]
    return {case.name: partial(answer, case) for case in some[:count]}


_STANDING = ("sticks", "nothing", "levels", "coarse encoder", "slew", "three")
SETS: dict[str, dict[str, Make]] = {
    "springs": _generated("mass_spring_damper", 8123, 24),
    "carts": _generated("cartpole", 8123, 24),
    "hexacopters": _generated("hexacopter", 8124, 4),
    "frictions": _numbered(partial(_studied, two_frictions.case, 1), 10),
    "positions": _numbered(partial(_studied, position_only.case, 32, full=False), 4),
    "positions with rates": _numbered(partial(_studied, position_only.case, 32, full=True), 4),
    "joints": _numbered(partial(_studied, two_joints.case, 202), 5),
    "laws of springs": _numbered(partial(_studied, partial(laws.case, "spring", 1.0), 3001), 10),
    "laws of carts": _numbered(partial(_studied, partial(laws.case, "cart", 1.0), 3001), 4),
    "odd springs": _numbered(partial(_odd_law, 8601), 4),
    "smoothed springs": _generated("mass_spring_damper", 8123, 10, smooth=True),
    "smoothed carts": _generated("cartpole", 8123, 8, smooth=True),
    "late": _late(8123, 6),
    "standing": {name.replace(" ", "_"): partial(_odd_machine, 1, name) for name in _STANDING},
    "closed loops": _flown(77, ("case_01", "case_05", "case_06", "case_07", "case_11", "case_15", "case_18")),
    "smoothed loops": _flown(77, ("case_01", "case_07", "case_15"), smoother=5),
}
"""Each answer has `right`, `null`, `inside` and the true names."""


def summary(content: Json) -> Json:
    return {
        "verdict": content["verdict"],
        "added": content["added"],
        "ties": sorted(sorted(tie["effects"]) for tie in content["ties"] or ()),
        "values": {k: [p["value"], p.get("interval_90")] for k, p in content["parameters"].items()},
        "leads": [f["name"] for f in content["findings"] if f["lead"]],
        "sure": sure(content),
    }


def outcome(make: Make, within: Callable[[], AbstractContextManager[None]], decisions: Json) -> Json:
    """Diagnose a case, with rules watched or switched off or another threshold, and judge it.

    Answers are judged by their names and intervals: an oracle that a study asks beside it is not worked out.
    """

    import nsde_torch.api.diagnosing as api
    from nsde_torch.diagnosis import pipeline
    from nsde_torch.diagnosis.decisions import DECISIONS, Options

    original, first, kept = pipeline.diagnose, dict[str, Any](), list[Any]()

    def diagnose(*args: Any, **how: Any) -> Any:
        if kept:
            return kept[0]
        if "alpha" in decisions:
            args = tuple(replace(a, **decisions) if isinstance(a, Options) else a for a in args)
        elif decisions:
            how["decisions"] = replace(how.get("decisions") or DECISIONS, **decisions)
        started = time.process_time()
        with within():
            kept.append(original(*args, **how))
            content = kept[0].content()
        first.update(summary(content), seconds=time.process_time() - started)
        return kept[0]

    pipeline.diagnose = api.diagnose_runs = diagnose
    judged = make()
    return {**first, **judged, "mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}


def _write(path: Path, make: Make, rule: str | None, decisions: Json) -> None:
    fired: dict[str, int] = {}
    within: Any = partial(counted, fired)
    if rule is not None:
        within = partial(without, next(r for r in RULES if r.name == rule))
    try:
        found = outcome(make, nullcontext if decisions else within, decisions)
    except Exception as error:  # without a rule a diagnosis may end
        found = {"error": repr(error)}
    write_json(path, {**found, "fired": fired})


def kept(out: Path, key: tuple[str, str], make: Make, rule: str | None = None, **decisions: Any) -> Json:
    """The outcome of a case: read, or made in a process of its own."""
    path = _path(out, key, rule, decisions)
    if not path.is_file():
        fork = multiprocessing.get_context("fork")
        process = fork.Process(target=_write, args=(path, make, rule, decisions))
        process.start()
        process.join()
        found = read_json(path)
        print(path.parent.name, *key, found.get("error") or f"{found.get('seconds', 0.0):.0f} s", flush=True)
    return dict(read_json(path))


def _path(out: Path, key: tuple[str, str], rule: str | None, decisions: Json) -> Path:
    folder = "all" if rule is None else "without " + rule.replace(":", "")
    for field, value in decisions.items():
        folder = f"{field} {value:g}"
    return out / folder.replace(" ", "_") / f"{'-'.join(key).replace(' ', '_')}.json"


def fires(out: Path, sets: Mapping[str, dict[str, Make]], count: int) -> Found:
    """Every case of some sets once, each rule watched."""
    import nsde_torch.diagnosis.pipeline  # noqa: F401  here once, and not in each process

    found = {}
    for k in range(count):  # in turn, so that a pass that was cut short has some of each
        for name, cases in sets.items():
            if k < len(cases):
                case = list(cases)[k]
                found[name, case] = kept(out, (name, case), cases[case])
    return found


def changes(before: Json, after: Json) -> list[str]:
    """What differs between the answers to one case."""
    keys = ("verdict", "added", "ties", "leads")
    out = [f"{k}: {before[k]} -> {after[k]}" for k in keys if before[k] != after[k]]
    for label in sorted({*before["values"]} & {*after["values"]}):
        (old, ends), (new, now) = before["values"][label], after["values"][label]
        if (ends is None) != (now is None):
            out.append(f"{label}: interval {ends} -> {now}")
        elif ends and now:
            moved = max(abs(a - b) for a, b in zip((old, *ends), (new, *now), strict=True))
            if moved > 0.05 * (ends[1] - ends[0]):
                out.append(f"{label}: {old:.4g} {ends} -> {new:.4g} {now}")
    return out


def worth(answer: Json) -> tuple[int, ...]:
    """What answers are compared by, the most important first; larger is better.

    Right or not; how few wrong effects are sure, or named; how many true ones are sure; how many intervals hold.
    """
    true = {*answer["truth"]}
    tied = {n for tie in answer["ties"] for n in tie if not true.isdisjoint(" + ".join(tie).split(" + "))}
    return (
        int(answer["right"]),
        -sum(name not in true for name in answer["sure"]),
        -sum(name not in true | tied for name in answer["added"]),
        sum(name in true for name in answer["sure"]),
        answer["inside"][0] - answer["inside"][1],
    )


def compared(before: Json, after: Json) -> tuple[str, list[str]]:
    """Whether another answer is better, worse or the same, and what differs."""
    if "error" in after:
        return "worse", [after["error"]]
    said, one, two = changes(before, after), worth(before), worth(after)
    if one == two:
        return ("same" if not said else "other"), said
    return ("better" if two > one else "worse"), said


def table(found: Found) -> list[str]:
    rows = []
    for name in dict.fromkeys(key[0] for key in found):
        all_of = [answer for key, answer in found.items() if key[0] == name]
        cases = [answer for answer in all_of if "error" not in answer]
        nulls = [c for c in cases if c["null"]]
        right, silent = sum(c["right"] for c in cases), sum(c["right"] for c in nulls)
        held = " of ".join(str(sum(c["inside"][k] for c in cases)) for k in (0, 1))
        seconds = sum(c.get("seconds", 0.0) for c in cases) / max(len(cases), 1)
        cells = f"{right} of {len(all_of)}", f"{silent} of {len(nulls)}", held, f"{seconds:.1f}"
        rows.append((name, *cells, f"{max((c['mb'] for c in cases), default=0.0):.0f}"))
    return markdown(("set", "right", "nulls silent", "intervals that hold", "CPU s a case", "MB"), rows)


def against(found: Found, other: Path) -> None:
    """Print what differs from the answers of other code."""
    differ = 0
    for key, answer in found.items():
        said = compared(read_json(_path(other, key, None, {})), answer)[1]
        differ += bool(said)
        for text in said:
            print(f"{' '.join(key)}: {text}")
    print(f"{differ} of {len(found)} answers differ")


def where(rule: str, found: Found) -> list[tuple[str, str]]:
    """Cases in which a rule fires, what takes least time first."""
    keys = [key for key in found if rule in found[key]["fired"]]
    return sorted(keys, key=lambda key: float(found[key].get("seconds", 0.0)))


def again(a: argparse.Namespace, found: Found) -> None:
    """Cases again without each rule, where it fires, until one gets worse; rules that fire in few cases first."""
    names = [rule.name for rule in RULES if not a.rules or rule.name in a.rules]
    for name in sorted(names, key=lambda rule: len(where(rule, found))):
        for key in where(name, found)[: a.most]:
            other = kept(a.out, key, SETS[key[0]][key[1]], name)
            if compared(found[key], other)[0] == "worse":
                break


def rules(out: Path, found: Found) -> list[str]:
    """One row a rule, and the answers that differ without it."""
    rows, details = [], []
    for rule in RULES:
        counts, worse = dict.fromkeys(("better", "worse", "other", "same"), 0), []
        for key in where(rule.name, found):
            path = _path(out, key, rule.name, {})
            if not path.is_file():
                continue
            what, said = compared(found[key], read_json(path))
            counts[what] += 1
            worse += [" ".join(key)] if what == "worse" else []
            details += [f"{rule.name}: {' '.join(key)}: {what}: {text}" for text in said if what != "same"]
        fired, tried = len(where(rule.name, found)), " / ".join(map(str, counts.values()))
        rows.append((f"`{rule.name}`: {rule.purpose}", fired, tried, ", ".join(worse)))
    head = ("rule", "fires in", "without it: better / worse / other / same", "cases that get worse")
    return [*markdown(head, rows), "", *details]


def thresholds(a: argparse.Namespace, found: Found) -> None:
    """Print which answers change where a number that decides stands at half or at twice its value."""
    from nsde_torch.diagnosis.decisions import DECISIONS
    from nsde_torch.errors import NsdeError

    print("\n".join(markdown(("field", "halved", "doubled"), [])))
    for field in fields(DECISIONS):
        value = getattr(DECISIONS, field.name)
        if field.name == "most_effects" or isinstance(value, bool) or not isinstance(value, int | float):
            continue
        cells = [f"`{field.name}`"]
        for factor in (0.5, 2.0):
            number = max(1, round(value * factor)) if isinstance(value, int) else value * factor
            try:
                replace(DECISIONS, **{field.name: number})
            except NsdeError:
                cells.append("not in range")
                continue
            others = {k: kept(a.out, k, SETS[k[0]][k[1]], None, **{field.name: number}) for k in found}
            worse = [" ".join(k) for k, other in others.items() if compared(found[k], other)[1]]
            cells.append(f"{len(worse)}: {', '.join(worse)}")
        print(line(cells), flush=True)


def main() -> None:
    parser = options(__doc__, "out", count=max(map(len, SETS.values())))
    parser.add_argument("what", choices=("run", "without", "rules", "thresholds"))
    parser.add_argument("--sets", nargs="*", choices=SETS, default=list(SETS), help="some sets")
    parser.add_argument("--against", type=Path, help="folder of the answers of other code")
    parser.add_argument("--most", type=int, default=6, help="most cases in which a rule is switched off")
    parser.add_argument("--rules", nargs="*", default=[], help="some of the rules alone")
    a = parser.parse_args()
    found = fires(a.out, {name: SETS[name] for name in a.sets}, a.count)
    if a.what == "run":
        print("\n".join(table(found)))
        if a.against is not None:
            against(found, a.against)
    elif a.what == "without":
        again(a, found)
    elif a.what == "rules":
        print("\n".join(rules(a.out, found)))
    else:
        thresholds(a, found)


if __name__ == "__main__":
    main()
