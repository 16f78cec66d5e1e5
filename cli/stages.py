"""Progress of work in stages: what is being done, how far it is, and how long the stage will yet take."""

from __future__ import annotations

import json
import os
import sys
import time
from typing import TextIO

PROGRESS = "NSDE_PROGRESS"
"""Variable of the environment: `json` makes each step a line of JSON, for a program that shows them."""


class Stages:
    """Prints a line per stage; on a terminal the line counts. With `NSDE_PROGRESS=json` every step is a line.

    Args:
        stream: Where to; standard error by default.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._live = self._stream.isatty()
        self._json = os.environ.get(PROGRESS) == "json"
        self._stage = ""
        self._started = self._first = time.monotonic()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Tell that `done` of `total` pieces of a stage are done."""
        now = time.monotonic()
        if self._json:
            told = {"stage": stage, "done": done, "total": total, "seconds": round(now - self._started, 3)}
            print(json.dumps(told), file=self._stream, flush=True)
            return
        if stage != self._stage:
            self._end()
            self._stage, self._first = stage, now
            if not self._live:
                print(f"[{now - self._started:5.0f} s] {stage}", file=self._stream, flush=True)
        if self._live:
            left = (now - self._first) / done * (total - done) if done else 0.0
            more = f" {done + 1} of {total}" if total > 1 else ""
            more += f", about {left:.0f} s left" if left >= 1 else ""
            line = f"[{now - self._started:5.0f} s] {stage}{more}"
            print(f"\r{line:<78}", end="", file=self._stream, flush=True)

    def _end(self) -> None:
        if self._live and self._stage:
            print(f"\r{f'[{time.monotonic() - self._started:5.0f} s] {self._stage}':<78}", file=self._stream)

    def close(self) -> None:
        """End the last line."""
        self._end()
        self._stage = ""
