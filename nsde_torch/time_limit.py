"""A limit of time for long work, noticed where one of its steps ends.

    with TimeLimit(600.0, still):  # seconds
        ...                        # `check_time()` in loops of this work, however deep: TimeUpError past the end

It needs no signal and no other thread, so that it holds in any thread and nothing is cut in the middle of a step.
"""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar
from math import inf
from time import perf_counter
from typing import final

ALIVE_S = 30.0


@final
class TimeUpError(Exception):
    """The time is up; no fault, so that what mends faults of numbers does not take it for one."""


@final
class TimeLimit:
    """Ends the work inside the block.

    Args:
        seconds: From now on [s]; None: no limit.
        still: Called about every `ALIVE_S` while the work goes on.

    Attributes:
        holds: Whether it ends anything yet; what is needed for any answer may take longer.
    """

    def __init__(self, seconds: float | None, still: Callable[[], None]) -> None:
        self._ends = inf if seconds is None else perf_counter() + seconds
        self._still, self._said = still, perf_counter()
        self.holds = True

    @property
    def left_s(self) -> float:
        """Time that is left [s]; infinite without a limit."""
        return self._ends - perf_counter()

    def look(self) -> None:
        """Go on, and say so where that has not been said for a while, unless the time is up (see `check_time`)."""
        now = perf_counter()
        if self.holds and now > self._ends:
            raise TimeUpError
        if now - self._said > ALIVE_S:
            self._said = now
            self._still()

    def __enter__(self) -> None:
        self._before = _LIMIT.set(self)

    def __exit__(self, *_: object) -> None:
        _LIMIT.reset(self._before)


_LIMIT: ContextVar[TimeLimit | None] = ContextVar("limit", default=None)


def check_time() -> None:
    """Go on, unless the time is up.

    Raises:
        TimeUpError: it is.
    """
    if (limit := _LIMIT.get()) is not None:
        limit.look()
