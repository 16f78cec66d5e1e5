"""What a regression can show: directions of theta that move the whitened residuals, others that do not, and a step.

With X the whitened slopes, a direction d is lost where |X d| is nothing: beside rounding (a singular value of the
columns scaled to equal length below 1e-5 of the largest, since inputs are often logged in single precision), or
beside the noise (it could move by a thousand typical sizes unseen).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

Array = NDArray[np.float64]

_ROUNDING = 1e-5
_UNSEEN = 1e3  # typical sizes
_PART = 0.05  # of the largest part of a direction: below that a parameter is left out of the sentence


@dataclass(frozen=True)
class Shown:
    """What the data show of theta."""

    basis: Array  # directions that are shown (k, r), in the units of theta
    lost: Array  # directions that are not (k, k - r), each with a largest part of one typical size
    known: NDArray[np.bool_]  # whether each parameter alone is shown (k,)
    condition: float  # largest over smallest singular value of the scaled slopes among the directions shown

    @property
    def rank(self) -> int:
        """Number of directions that are shown."""
        return self.basis.shape[1]


def shown(slopes: Array, scale: Array) -> Shown:
    """Directions that whitened slopes (N, k) show of parameters of typical sizes `scale` (k,)."""
    k = slopes.shape[1]
    length = np.linalg.norm(slopes, axis=0)
    dead = length * scale * _UNSEEN < 1.0
    live = np.flatnonzero(~dead)
    size = 1.0 / np.where(dead, 1.0, length)
    if not len(live):
        return Shown(np.zeros((k, 0)), np.diag(scale), np.zeros(k, dtype=bool), 1.0)
    triangle = np.linalg.qr(slopes[:, live] * size[live], mode="r")
    _, values, directions = np.linalg.svd(triangle)
    values = np.concatenate((values, np.zeros(len(live) - len(values))))
    # how many typical sizes the parameters go where the data see one standard deviation
    reach = (np.abs(directions) * (size / scale)[live]).max(1) / np.maximum(values, 1e-300)
    seen = (values > _ROUNDING * values[0]) & (reach < _UNSEEN)
    basis = np.zeros((k, int(seen.sum())))
    basis[live] = (directions[seen] * size[live]).T
    lost = np.zeros((k, int((~seen).sum())))
    lost[live] = (directions[~seen] * size[live]).T
    alone = np.zeros((k, int(dead.sum())))
    alone[np.flatnonzero(dead), np.arange(int(dead.sum()))] = scale[dead]
    readable = np.concatenate((alone, _readable(lost, scale)), 1)
    known = ~dead
    known[live] &= np.square(directions[~seen]).sum(0) < 1e-6
    condition = float(values[seen][0] / values[seen][-1]) if seen.any() else 1.0
    return Shown(basis, readable, known, condition)


def _readable(directions: Array, scale: Array) -> Array:
    """The same space with as many zeros as pivoting gives, each direction with a largest part of one typical size."""
    rows = (directions / scale[:, None]).T.copy()
    for i in range(len(rows)):
        row, column = np.unravel_index(np.argmax(np.abs(rows[i:])), rows[i:].shape)
        rows[[i, i + int(row)]] = rows[[i + int(row), i]]
        rows[i] /= rows[i, column]
        others = np.arange(len(rows)) != i
        rows[others] -= np.outer(rows[others, column], rows[i])
    largest = np.abs(rows).max(1, keepdims=True, initial=1e-300)
    return np.asarray((rows / largest).T * scale[:, None])


def sentences(found: Shown, labels: Sequence[str], units: Sequence[str], scale: Array) -> list[str]:
    """What the data cannot show, in words."""
    out = []
    for direction in found.lost.T:
        share = np.abs(direction) / scale
        parts = [i for i in np.argsort(-share) if share[i] > _PART * share.max()]
        if len(parts) == 1:
            out.append(f"{labels[parts[0]]}: nothing in the data depends on it")
            continue
        moves = ", ".join(f"{labels[i]} by {direction[i]:+.3g} {units[i]}" for i in sorted(parts))
        names = " and ".join(labels[i] for i in sorted(parts))
        out.append(f"{names}: only together; the data look the same with {moves}")
    return out


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
