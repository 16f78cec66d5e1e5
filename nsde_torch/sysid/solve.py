"""One step of least squares within bounds, in the directions that the data show."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from nsde_torch.sysid.shown import Shown

Array = NDArray[np.float64]


def bounded_step(
    slopes: Array, residual: Array, found: Shown, low: Array, high: Array, scale: Array
) -> Array:
    """The step d (k,) that minimises |residual - slopes d| with low <= d <= high, none of it along what is lost.

    Of whitened slopes (N, k) and residuals (N,), bounds (k,) that hold 0, and typical sizes `scale` (k,).
    """
    free = found.basis @ np.linalg.lstsq(slopes @ found.basis, residual, rcond=None)[0]
    if ((free >= low) & (free <= high)).all():
        return np.asarray(free)
    k = slopes.shape[1]
    triangle: Array = np.linalg.qr(np.column_stack((slopes, residual)), mode="r")  # type: ignore[assignment]
    size = max(float(np.abs(triangle[:k, :k] * scale).max()), 1.0)
    still = size * (found.lost / scale[:, None] ** 2).T  # rows that hold the step still along what is lost
    rows = np.concatenate((triangle[:k, :k], still)) * scale
    target = np.concatenate((triangle[:k, k], np.zeros(len(still))))
    result = lsq_linear(rows, target, bounds=(low / scale, high / scale), method="bvls")
    return np.asarray(np.clip(result.x * scale, low, high))
