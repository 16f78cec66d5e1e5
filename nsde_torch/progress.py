"""Progress of long work: what is being done, how far it is, what was found so far, and roughly how long is left."""

from __future__ import annotations

import json
import logging
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal, TextIO

PROGRESS = "NSDE_PROGRESS"
"""Variable of the environment: `json` makes each step a line of JSON, for a program that shows them."""

LOG = logging.getLogger(__name__)
"""Takes each stage when it begins, for the file of a job; a handler that writes to a terminal shows it twice."""

WHEN_COMPILING: list[Callable[[], None]] = []
"""Called once, when loops are compiled that this machine has not run yet."""

_AGAIN_S = 25.0  # after which the line of a stage that lasts is printed again
Say = Callable[[str, int, int], None]
"""Takes stage, number done and number in all."""


def silent(stage: str, done: int, total: int) -> None:
    """Say nothing."""


def no_bar(quiet: bool = False) -> bool | None:
    """`disable=` of a bar of tqdm: shown in a terminal and in a notebook, which is none, and not in a file.

    Args:
        quiet: Never.
    """
    return True if quiet else (False if "ipykernel" in sys.modules else None)


class Stages:
    """Prints a line per stage, again while it lasts; on a terminal the line counts.

    With `NSDE_PROGRESS=json` every step is a line.

    Args:
        stream: Where to; standard error by default.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._json = os.environ.get(PROGRESS) == "json"
        self._live = self._stream.isatty() and not self._json
        self._stage = self._found = ""
        self._started = self._first = self._shown = time.monotonic()
        self._ends: float | None = None

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Say that `done` of `total` pieces of a stage are done."""
        now = time.monotonic()
        new = stage != self._stage
        if new:
            self._end()
            self._stage, self._first = stage, now
        if new or now - self._shown > _AGAIN_S:
            self._shown = now
            line = self._line(now, left=self._left(now))
            if new:
                LOG.info(line)
            if not (self._live or self._json):
                print(line, file=self._stream, flush=True)
        if self._json:
            step = {"stage": stage, "done": done, "total": total, "seconds": round(now - self._started, 3)}
            step |= {"found": self._found} if self._found else {}
            print(json.dumps(step), file=self._stream, flush=True)
        if self._live:
            count = f", {done + 1} of {total}" if total > 1 else ""
            own = (now - self._first) / done * (total - done) if done else 0.0
            left = self._left(now) or (f"about {own:.0f} s left of this" if own >= 1 else "")
            print(f"\r{self._fitting(self._line(now, count, left))}", end="", file=self._stream, flush=True)

    def known(self, found: str, left_s: float | None) -> None:
        """Take what the next lines say beside the stage.

        Args:
            found: What was found so far, in a few words; empty while that is nothing.
            left_s: Roughly how long all of the work will yet take [s]; None: not known.
        """
        self._found, self._ends = found, None if left_s is None else time.monotonic() + left_s

    def close(self) -> None:
        """End the last line."""
        self._end()
        self._stage = ""

    def _line(self, now: float, count: str = "", left: str = "") -> str:
        found = f"so far: {self._found}" if self._found else ""
        said = "; ".join(part for part in (f"{self._stage}{count}", found, left) if part)
        return f"[{now - self._started:5.0f} s] {said}"

    def _left(self, now: float) -> str:
        """Roughly how long all will yet take; empty where nobody knows, or where it has taken longer than that."""
        left = 0.0 if self._ends is None else self._ends - now
        if left < 1.0:
            return ""
        return (
            f"roughly {left / 60:.0f} min left"
            if left > 100
            else f"roughly {max(round(left, -1), 10):.0f} s left"
        )

    def _end(self) -> None:
        if self._live and self._stage:
            print(f"\r{self._fitting(self._line(time.monotonic()))}", file=self._stream)

    def _fitting(self, line: str) -> str:
        """A line as wide as the terminal: a longer one would not be written over."""
        width = max(shutil.get_terminal_size().columns - 1, 40)
        return f"{line[: width - 3]}..." if len(line) > width else f"{line:<{width}}"


@contextmanager
def reported(say: Say | Literal[False] | None) -> Iterator[Say]:
    """What takes the steps of a function for people: by default they are printed.

    Args:
        say: None: `Stages` prints on standard error; False: nothing is printed; or what takes them.
    """
    stages = Stages() if say is None else None
    try:
        yield stages or say or silent
    finally:
        if stages is not None:
            stages.close()
