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
    rng: np.random.Generator,
    noise: Sequence[float] | float = 0.0,
    kick: Sequence[float] | float = 0.0,
    control: Callable[[Array, Array], Sequence[float] | Array] = lambda wanted, seen: wanted,
    fine: int = 10,
) -> RawRun:
    """A run of x' = rates(x, u) + kick dW that logs rows `dt` [s] apart, `fine` steps each.

    Inputs (N, nu) are held over each row, or what `control` makes of a row of them and of what sensors see, whose white
    noise has these standard deviations.
    """
    y, h = np.array(start, dtype=np.float64), dt / fine
    x, kicks = np.empty((len(inputs), len(y))), np.array(kick) * np.sqrt(h)
    u, errors = np.array(inputs, dtype=np.float64), noise * rng.standard_normal((len(inputs), len(y)))
    for k, wanted in enumerate(inputs):
        x[k] = y + errors[k]
        u[k] = control(wanted, x[k])
        for _ in range(fine):
            a = np.asarray(rates(y, u[k]))
            b = np.asarray(rates(y + 0.5 * h * a, u[k]))
            c = np.asarray(rates(y + 0.5 * h * b, u[k]))
            y = y + h / 6.0 * (a + 2.0 * b + 2.0 * c + np.asarray(rates(y + h * c, u[k])))
            y += kicks * rng.standard_normal(len(y)) if kicks.any() else 0.0
    return RawRun(f"run_{number}", 1000.0 * number + dt * np.arange(len(x)), x, u)


def held(rng: np.random.Generator, low: float, high: float, rows: int, *, each: int) -> Array:
    """Inputs (rows, 1) that are drawn anew after so many rows."""
    return np.repeat(rng.uniform(low, high, -(-rows // each)), each)[:rows, None]
