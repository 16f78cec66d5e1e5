"""Runs of machines that a test writes down as rates: by Runge and Kutta's rule, in NumPy alone."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data import RawRun

Array = NDArray[np.float64]


def simulated(
    number: int,
    rates: Callable[[Array, Array], Sequence[float] | Array],
    start: Sequence[float],
    inputs: Array,
    dt: float,
    *,
    noise: Sequence[float] | float = 0.0,
    rng: np.random.Generator,
    fine: int = 10,
) -> RawRun:
    """A run of x' = rates(x, u) that logs rows `dt` [s] apart, `fine` steps each.

    Inputs (N, nu) are held over each row; sensors have white noise of these standard deviations.
    """
    x, y, h = np.empty((len(inputs), len(start))), np.array(start, dtype=np.float64), dt / fine
    for k, u in enumerate(inputs):
        x[k] = y
        for _ in range(fine):
            a = np.asarray(rates(y, u))
            b = np.asarray(rates(y + 0.5 * h * a, u))
            c = np.asarray(rates(y + 0.5 * h * b, u))
            y = y + h / 6.0 * (a + 2.0 * b + 2.0 * c + np.asarray(rates(y + h * c, u)))
    t = 1000.0 * number + dt * np.arange(len(x))
    return RawRun(f"run_{number}", t, x + noise * rng.standard_normal(x.shape), inputs)


def held(rng: np.random.Generator, low: float, high: float, rows: int, *, each: int) -> Array:
    """Inputs (rows, 1) that are drawn anew after so many rows."""
    return np.repeat(rng.uniform(low, high, -(-rows // each)), each)[:rows, None]
