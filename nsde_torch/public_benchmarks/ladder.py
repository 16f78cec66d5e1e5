"""Terms that are added one after another while simulations of what was held out get better."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

Rung = Mapping[str, Any]
"""What a fit made: `effects`, `values`, and its error on what was held out."""


def ladder(
    tried: Callable[[tuple[str, ...], Mapping[str, Any]], Rung],
    candidates: Iterable[str],
    *,
    first: Mapping[str, Any],
    error: str,
    gain: float,
) -> list[Rung]:
    """Fits without any term and with one more in each, the best first.

    Args:
        tried: Fits terms from first values.
        candidates: Names of the terms.
        first: Values of the declared physics to start from.
        error: Key of the error on what was held out.
        gain: Share of that error by which one more term has to lower it.
    """
    rungs, names = [tried((), first)], tuple(candidates)
    while True:
        last = rungs[-1]
        taken = tuple(last["effects"])
        more = [tried((*taken, name), last["values"]) for name in names if name not in taken]
        best = min(more, key=lambda made: float(made[error]), default=None)
        if best is None or best[error] > (1.0 - gain) * last[error]:
            return rungs
        rungs.append(best)
