"""How much a column scatters from row to row: what a cubic leaves of it, the steps that its values come in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_CURVE = 1.39  # what a cubic leaves of white noise, over its standard deviation
_DIGITS, _SOME = 8, 2000  # most significant digits that are few, and values that are looked at


def off_curve(x: Array) -> Array:
    """What a cubic through the two neighbours on each side leaves of each sample; nothing at the ends.

    Args:
        x: Samples at equal distances, (n,).

    Returns:
        Differences, (n,).
    """
    out = np.zeros_like(x)
    out[2:-2] = x[2:-2] - (4.0 * (x[1:-3] + x[3:-1]) - (x[:-4] + x[4:])) / 6.0
    return out


def white(x: Array) -> float:
    """Robust standard deviation of the white noise of a column [its unit]; nothing below five samples."""
    return 1.4826 / _CURVE * float(np.median(np.abs(off_curve(x)[2:-2]))) if len(x) > 4 else 0.0


def quantum(x: Array) -> float:
    """The step that values of a column come in [its unit]; the median of `grains`, 0 where there is none."""
    all_of = grains(x)
    return float(np.median(all_of)) if len(all_of) else 0.0


def grains(x: Array) -> Array:
    """The step that each value of a column comes in [its unit]: the smallest distance of two, beyond floats' rounding.

    Where values were written with some significant digits the smallest of them come in smaller steps than the others;
    it is then the last digit of each.

    Args:
        x: Values (n,), without missing ones.

    Returns:
        Steps (n,).
    """
    steps = np.diff(np.unique(x))
    steps = steps[steps > 1e-9 * max(float(np.abs(x).max(initial=0.0)), 1e-300)]
    if not len(steps):
        return np.zeros_like(x)
    size = np.abs(x)
    place = np.floor(np.log10(np.maximum(size, 1e-300)))
    some = np.flatnonzero(size > 0)
    some = some[:: max(1, len(some) // _SOME)]
    for digits in range(1, _DIGITS + 1):
        last = 10.0 ** (place - digits + 1)
        off = size[some] / last[some]
        if (np.abs(off - np.round(off)) < 1e-3 * 10.0 ** (digits - _DIGITS)).all():
            return np.maximum(last, float(steps.min()))
    return np.full_like(x, float(steps.min()))
