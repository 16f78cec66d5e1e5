"""A limit of time for long work, noticed where one of its steps ends.

    with TimeLimit(600.0) as limit:       # seconds
        ...                               # `check_time()` in loops of this work, however deep: TimeUpError past the end

It needs no signal and no other thread, so that it holds in any thread and nothing is cut in the middle of a step.
"""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar, Token
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

    def __init__(self, seconds: float | None, still: Callable[[], None] | None = None) -> None:
        self._ends = inf if seconds is None else perf_counter() + seconds
        self._still, self._said = still, perf_counter()
        self._before: list[Token[TimeLimit | None]] = []
        self.holds = True

    @property
    def left_s(self) -> float:
        """Time that is left [s]; infinite without a limit."""
        return self._ends - perf_counter()

    def alive(self) -> None:
        """Say that the work goes on, where it has not been said for a while."""
        now = perf_counter()
        if self._still is not None and now - self._said > ALIVE_S:
            self._said = now
            self._still()

    def __enter__(self) -> TimeLimit:
        self._before.append(_LIMIT.set(self))
        return self

    def __exit__(self, *_: object) -> None:
        _LIMIT.reset(self._before.pop())


_LIMIT: ContextVar[TimeLimit | None] = ContextVar("limit", default=None)


def check_time() -> None:
    """Go on, unless the time is up.

    Raises:
        TimeUpError: it is.
    """
    limit = _LIMIT.get()
    if limit is None:
        return
    if limit.holds and limit.left_s < 0.0:
        raise TimeUpError
    limit.alive()
