"""A study: cases that are made, diagnosed and judged one after another, each answer in a file of its own."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

Json = dict[str, Any]


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
