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
_NEAR: Array = np.linspace(-0.45, 0.45, 10)


@dataclass(frozen=True)
class Repeat:
    """The period that helps most.

    Args:
        period: Of the variable, in its unit.
        nats: Log-likelihood that sine and cosine bring.
        columns: Orthonormal columns (N, 2) of them, whitened and free of what the parameters can do.
    """

    period: float
    nats: float
    columns: Array


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

    def tried(count: float) -> Repeat:
        angle = 2.0 * np.pi * count * (v - low) / span
        waves = np.stack((np.sin(angle), np.cos(angle)), 1) * regression.dt
        z = regression.whitened(regression.noises[channel], waves)
        z = np.linalg.qr(z - own @ (own.T @ z))[0]
        pull = z.T @ white
        return Repeat(span / count, 0.5 * float(pull @ pull), z)

    best = max((tried(float(count)) for count in COUNTS), key=lambda r: r.nats)
    near = span / best.period + _NEAR
    return max((best, *(tried(float(count)) for count in near)), key=lambda r: r.nats)
