"""Dependence on a variable that repeats along it: teeth, magnets, bearings, thread.

    r(v) = a sin(2 pi n (v - low) / span) + b cos(2 pi n (v - low) / span)

for n from one and a half to forty periods over the range of v: finer than bins and hats can see. With M trials the
chance of the best is M times that of one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nsde_torch.sysid.regression import Regression

Array = NDArray[np.float64]

COUNTS: Array = np.arange(1.5, 40.5, 0.5)
"""Periods over the range that are tried."""
_TOGETHER = 8  # that are whitened at once
_NEAR: Array = np.linspace(-0.45, 0.45, 10)


@dataclass(frozen=True)
class Repeat:
    """The period that helps most."""

    period: float  # of the variable, in its unit
    nats: float  # log-likelihood that sine and cosine bring
    columns: Array  # orthonormal columns (N, 2) of them, whitened and free of what the parameters can do


def best_repeat(regression: Regression, channel: int, v: Array, own: Array) -> Repeat | None:
    """The best period of a variable, or None where it does not move.

    Args:
        regression: Its residuals.
        channel: Number of the channel among its rows.
        v: The variable (M,).
        own: Orthonormal columns (N, r) of what the parameters can do.
    """
    low, high = np.quantile(v, [0.005, 0.995])
    span = float(high - low)
    if not span > 0:
        return None
    white = regression.white[channel]

    turn = 2.0 * np.pi * (v - low) / span

    def waves(counts: Array) -> Array:
        """Sines and cosines (N, 2, counts), whitened and free of what the parameters can do."""
        angle = turn[:, None] * counts
        both = np.concatenate((np.sin(angle), np.cos(angle)), 1) * regression.dt
        z = regression.whitened(regression.noises[channel], both)
        return np.asarray(z - own @ (own.T @ z)).reshape(len(z), 2, len(counts))

    def nats(counts: Array) -> Array:
        """Log-likelihood that each brings."""
        z = waves(counts)
        gram, pull = np.einsum("nik,njk->kij", z, z), np.einsum("nik,n->ki", z, white)
        return 0.5 * np.einsum("ki,kij,kj->k", pull, np.linalg.pinv(gram, rcond=1e-12), pull)

    def best_of(counts: Array) -> float:
        brought = np.concatenate([nats(counts[k : k + _TOGETHER]) for k in range(0, len(counts), _TOGETHER)])
        return float(counts[brought.argmax()])

    coarse = best_of(COUNTS)
    best = best_of(np.append(coarse, coarse + _NEAR))
    z = np.linalg.qr(waves(np.array([best]))[..., 0])[0]
    pull = z.T @ white
    return Repeat(span / best, 0.5 * float(pull @ pull), z)
