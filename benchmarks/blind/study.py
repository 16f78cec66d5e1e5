"""What studies share: logs as CSV files, cases that are diagnosed and judged one after another, intervals that hold."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Json = dict[str, Any]


def save(path: Path, names: Iterable[str], columns: Sequence[Any], fmt: str | list[str] = "%.9g") -> None:
    """Write columns, (n,) or (n, C), under their names as a CSV file."""
    np.savetxt(path, np.column_stack(columns), fmt, ",", header=",".join(names), comments="")


def labelled(effects: Mapping[str, Mapping[str, Any]]) -> Iterator[tuple[str, float]]:
    """Labels of `diagnosis.json` and values of the parameters of effects; those of a list are numbered."""
    for effect, values in effects.items():
        for name, value in values.items():
            many = isinstance(value, list) and len(value) > 1
            for i, v in enumerate(value if isinstance(value, list) else [value]):
                yield f"{effect}.{name}" + (f"[{i}]" if many else ""), v


def holds(said: Mapping[str, Any], value: float) -> bool:
    """Whether the 90 % interval of a parameter holds a value; an end that is a bound of the fit is open."""
    (low, high), bound = said["interval_90"], said.get("bound")
    return bool((bound == "below" or low <= value) and (bound == "above" or value <= high))


def held(effects: Mapping[str, Mapping[str, Any]], parameters: Mapping[str, Any]) -> list[int]:
    """How many intervals hold the true values of effects, and how many there are; values of nothing do not count."""
    said = [(parameters.get(label) or {}, value) for label, value in labelled(effects) if abs(value) > 1e-5]
    inside = [holds(one, value) for one, value in said if one.get("interval_90")]
    return [sum(inside), len(inside)]


def options(description: str, *, count: int) -> argparse.ArgumentParser:
    """Seed, number of the first case, number of cases, and the folder of the answers."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--count", type=int, default=count)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    return parser


def answers(
    out: Path,
    cases: Iterable[tuple[str, Callable[[], Json], Json]],
    finish: Callable[[Json], str],
) -> list[Json]:
    """Answer cases, print a line for each, and return all answers of the folder.

    Args:
        out: Folder of the answers.
        cases: Name of the answer's file, what makes the answer, and the answer where that ends in an error, which
            counts as wrong.
        finish: Adds to an answer what it is worth; returns the line.
    """
    out.mkdir(parents=True, exist_ok=True)
    for name, make, wrong in cases:
        try:
            answer = make()
        except Exception as error:
            answer = {**wrong, "error": repr(error)}
        line = finish(answer)
        (out / f"{name}.json").write_text(json.dumps(answer, indent=1, default=float), encoding="utf-8")
        print(line, flush=True)
    return [json.loads(path.read_text(encoding="utf-8")) for path in sorted(out.glob("*.json"))]


def appended(file: Path, cases: Iterable[Callable[[], Json]], line: Callable[[Json], str]) -> None:
    """Append the outcome of each case to a file of JSON lines, and print a line for each.

    Args:
        file: The file; its folder is made.
        cases: What makes each outcome.
        line: What is printed of one.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a", encoding="utf-8") as out:
        for make in cases:
            found = make()
            print(json.dumps(found), file=out, flush=True)
            print(line(found), flush=True)
