"""How much a column scatters from row to row: what a cubic leaves of it, the steps that its values come in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_CURVE = 1.39  # what a cubic leaves of white noise, over its standard deviation


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
    """Smallest distance of two values of a column [its unit], beyond the rounding of floats."""
    steps = np.diff(np.unique(x))
    steps = steps[steps > 1e-9 * max(float(np.abs(x).max()), 1e-300)]
    return float(steps.min()) if len(steps) else 0.0
