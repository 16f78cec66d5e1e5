"""Rates of positions by alpha-beta filters: the steady Kalman filter of a mass that white accelerations push.

    e_k = q_k - (p + h v),   p <- p + h v + alpha e_k,   v <- v + beta e_k / h

With the tracking index L = h^2 (size of the accelerations) / (noise of the position) (Kalata, The tracking index, IEEE
Transactions on Aerospace and Electronic Systems 20 (1984)):

    r = (4 + L - (8 L + L^2)^1/2) / 4,   alpha = 1 - r^2,   beta = 2 (2 - alpha) - 4 (1 - alpha)^1/2
    noise of q = (1 - alpha) S,   what is not known of v = beta (2 alpha - beta) / (2 (1 - alpha)) noise / h^2,

S the mean square of e. The index is that of the smallest S.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log10, sqrt

import numpy as np
from scipy.signal import lfilter

from nsde_torch.arrays import Array

_SLOWEST_S = 0.15  # longest time constant of a filter: what it forgets in
_LARGEST = 30.0  # tracking index: the position as it is
_FIRST = 30  # rows at the start of a stretch that do not judge a filter


@dataclass(frozen=True)
class AlphaBeta:
    """An alpha-beta filter.

    Args:
        alpha, beta: See the module.
    """

    alpha: float
    beta: float

    def unknown(self, square: float, dt: float) -> float:
        """Standard deviation of what is not known of the rate, from the mean square of e and the step."""
        kept = max(1.0 - self.alpha, 1e-9)
        share = max(self.beta * (2.0 * self.alpha - self.beta) / (2.0 * kept), 0.0)
        return sqrt(share * kept * square) / dt


def gains(dt: float, count: int) -> list[AlphaBeta]:
    """Filters from the slowest one to one that takes positions as they are, for a step [s]."""
    low = min((dt / _SLOWEST_S) ** 2, 0.1)
    out = []
    for index in np.logspace(log10(low), log10(_LARGEST), count).tolist():
        r = (4.0 + index - sqrt(8.0 * index + index * index)) / 4.0
        alpha = 1.0 - r * r
        out.append(AlphaBeta(alpha, 2.0 * (2.0 - alpha) - 4.0 * sqrt(1.0 - alpha)))
    return out


def rates(stretches: Sequence[Array], dt: float) -> tuple[list[Array], float]:
    """Rates of positions (n,) without any physics, of the rows before and after alike, and what is not known of them.

    Args:
        stretches: Positions without a gap, on one step.
        dt: The step [s].
    """
    best, chosen = np.inf, gains(dt, 1)[0]
    for one in gains(dt, 17):
        errors = [_filtered(q, dt, one)[0][_FIRST:] for q in stretches if len(q) > 2 * _FIRST]
        square = float(np.square(np.concatenate(errors)).mean()) if errors else 0.0
        if square < best:
            best, chosen = square, one
    out = []
    for q in stretches:
        after = -_filtered(q[::-1], dt, chosen)[1][::-1]
        out.append(0.5 * (_filtered(q, dt, chosen)[1] + after))
    return out, chosen.unknown(best, dt) * sqrt(0.5)


def _filtered(q: Array, dt: float, g: AlphaBeta) -> tuple[Array, Array]:
    """Errors of prediction and rates (n,)."""
    first = min(len(q), 10)
    slope = float(np.polyfit(np.arange(first), q[:first], 1)[0]) if first > 1 else 0.0
    left = q - q[0] - slope * np.arange(len(q))  # it starts at rest where the stretch does
    poles = [1.0, g.alpha + g.beta - 2.0, 1.0 - g.alpha]
    e = lfilter([1.0, -2.0, 1.0], poles, left)
    v = lfilter([g.beta / dt, -g.beta / dt], poles, left)
    return np.asarray(e), np.asarray(v + slope / dt)
