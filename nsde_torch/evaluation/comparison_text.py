"""An evaluation as a person reads it in a terminal: lines, and which of them are red."""

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from nsde_torch.evaluation.one_step import one_step_table
from nsde_torch.evaluation.report import BASELINE_NAMES, REPLAYED, SHOWN_LEVELS, number, table

Line = tuple[str, bool]
SEEN = "TRAINED ON"
_WIDTH = 110


def lines(content: Mapping[str, Any]) -> Iterator[Line]:
    """All lines of `evaluation.json`; red are figures on runs that a model was trained on, or that are not reliable."""
    every = content["start_every_s"]
    where = "interventions (inputs do not depend on the state)"
    if every is not None:
        where = f"starts every {every:g} s"
    yield f"{content['system']}: {content['starts']} {where}, {content['particles']} paths each", False
    yield "", False
    yield from _runs(content)
    yield "", False
    yield from _one_step(content)
    several = (_differences,) if len(content["models"]) > 1 else ()
    for part in (_errors, _intervals, *several):
        yield from part(content)
        yield "", False
    yield from _verdicts(content)
    for remark in content["notes"]:
        yield from _wrapped(f"note: {remark['text']}", remark["red"])


def label(model: Mapping[str, Any]) -> str:
    """Name of a model, with a mark if it was trained on any of the runs."""
    return str(model["name"]) if model["held_out"] else f"{model['name']} ({SEEN})"


def _lines(head: Sequence[str], rows: Sequence[tuple[Sequence[str], bool]]) -> Iterator[Line]:
    text = table(head, [row for row, _ in rows]).splitlines()
    yield from ((line, False) for line in text[:2])
    yield from ((line, red) for line, (_, red) in zip(text[2:], rows, strict=True))


def _runs(content: Mapping[str, Any]) -> Iterator[Line]:
    models = content["models"]
    rows = []
    for run in content["data"]["runs"]:
        seen = [SEEN if m["trained_on"][run["name"]] else "held out" for m in models]
        row = [run["name"], f"{run['duration_s']:.1f}", str(run["starts"]), *seen]
        rows.append((row, SEEN in seen))
    yield from _lines(["run", "seconds", "starts", *(m["name"] for m in models)], rows)


def _one_step(content: Mapping[str, Any]) -> Iterator[Line]:
    for m in content["models"]:
        if m["one_step"]:
            yield f"{label(m)}: what it leaves of single steps", not m["held_out"]
            yield from ((line, not m["held_out"]) for line in one_step_table(m["one_step"]).splitlines())
            yield "", False


def _errors(content: Mapping[str, Any]) -> Iterator[Line]:
    horizons = [f"{h:g}" for h in content["horizons_s"]]
    named = [(label(m), m["errors"], not m["held_out"]) for m in content["models"]]
    named += [(name, content["baselines"][key], False) for key, name in BASELINE_NAMES.items()]
    rows = [
        ([f"{group} [{unit}]", name, *(_cell(errors, group, h) for h in horizons)], red)
        for group, unit in content["units"]["errors"].items()
        for name, errors, red in named
    ]
    what = "rms error" if content["start_every_s"] is None else REPLAYED
    yield from _lines([what, "", *(f"{h} s" for h in horizons)], rows)


def _cell(table: Mapping[str, Any] | None, group: str, horizon: str, form: str = "") -> str:
    value = None if not table else table[group][horizon]
    if value is None:
        return "-"
    return format(value, form) if form else number(value)


def _intervals(content: Mapping[str, Any]) -> Iterator[Line]:
    horizons = [f"{h:g}" for h in content["horizons_s"]]
    rows = []
    for group, unit in content["units"]["crps"].items():
        for what in (*SHOWN_LEVELS, f"CRPS [{unit}]", "NLL [nat]"):
            for m in content["models"]:
                if what in SHOWN_LEVELS:
                    name, source = f"{float(what):.0%} interval", (m["coverage"] or {}).get(what)
                else:
                    name, source = what, m["crps"] if what.startswith("CRPS") else m["nll"]
                if not m["stochastic"] and not what.startswith("CRPS"):
                    continue  # a note says so
                cells = [_cell(source, group, h, ".0%" if what in SHOWN_LEVELS else "") for h in horizons]
                rows.append(([group, name, label(m), *cells], not m["held_out"]))
    yield from _lines(["intervals and scores", "", "", *(f"{h} s" for h in horizons)], rows)


def _differences(content: Mapping[str, Any]) -> Iterator[Line]:
    differences = content["differences"]
    first = differences["first"]
    rows = []
    for name, other in differences["against"].items():
        if name in BASELINE_NAMES:
            continue
        for group, by_horizon in other["errors"].items():
            unit = content["units"]["differences"][group]
            for h, d in by_horizon.items():
                if d is None:
                    cells = ["-"] * 5
                else:
                    ends = "-" if d["low"] is None else f"[{number(d['low'])}, {number(d['high'])}]"
                    word = d["verdict"] + ("" if other["held_out"] else f" ({SEEN})")
                    cells = [number(d["first"]), number(d["other"]), f"{d['difference']:+.3g}", ends, word]
                rows.append(([name, f"{group} [{unit}]", f"{h} s", *cells], not other["held_out"]))
    method = (
        f"paired bootstrap over {differences['blocks']} {differences['unit']}, {differences['replicates']} resamples; "
        "each interval stands for itself, of twenty one may err"
    )
    yield from _wrapped(f"difference of rms errors to {first}: {method}", False)
    head = ["model", "", "", first, "its own", "difference", f"{differences['level']:.0%} interval", ""]
    yield from _lines(head, rows)


def _verdicts(content: Mapping[str, Any]) -> Iterator[Line]:
    """The first model against the baselines, in words."""
    differences = content["differences"]
    turned = {"better": "worse", "worse": "better"}
    for key, name in BASELINE_NAMES.items():
        words: dict[str, list[str]] = {}
        for group, by_horizon in differences["against"][key]["errors"].items():
            by_word: dict[str, list[str]] = {}
            for h, d in by_horizon.items():
                if d is not None:
                    by_word.setdefault(turned.get(d["verdict"], d["verdict"]), []).append(h)
            for word, horizons in by_word.items():
                words.setdefault(word, []).append(f"{group} at {_range(horizons, list(by_horizon))}")
        held_out = differences["against"][key]["held_out"]
        text = "; ".join(f"{word} in {', '.join(where)}" for word, where in words.items())
        if text:
            mark = "" if held_out else f" ({SEEN})"
            yield from _wrapped(f"{differences['first']}{mark} against {name}: {text}", not held_out)


def _range(horizons: Sequence[str], every: Sequence[str]) -> str:
    """`all horizons`, `0.1 to 1 s`, or `0.1, 1 s`."""
    if list(horizons) == list(every):
        return "all horizons"
    first = every.index(horizons[0])
    if len(horizons) > 2 and list(horizons) == list(every[first : first + len(horizons)]):
        return f"{horizons[0]} to {horizons[-1]} s"
    return f"{', '.join(horizons)} s"


def _wrapped(text: str, red: bool) -> Iterator[Line]:
    yield from ((line, red) for line in textwrap.wrap(text, _WIDTH, subsequent_indent="  "))
