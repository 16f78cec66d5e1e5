"""Spectral lines in whitened residuals: a force that swings at a frequency of its own.

The periodogram of white noise is exponential at every frequency; the largest of M ordinates exceeds
-log(1 - (1 - p)^(1/M)) times their mean with chance p (Fisher, Proceedings of the Royal Society A 125 (1929)).
"""

import numpy as np
from numpy.typing import NDArray

from nsde_torch.learning.identify.identify import Regression
from nsde_torch.learning.identify.noise import extended

Array = NDArray[np.float64]

_SHORTEST_S = 1.0
_PEAKS = 3
_FINER = 8


def periodogram(regression: Regression) -> tuple[Array, Array]:
    """Frequencies [Hz] (M,) and mean power of the whitened residual per channel (channels, M), 1 for white noise.

    Stretches are transformed on one grid with zeros behind them, and their powers are weighted by their lengths.
    """
    edges = extended(regression.series).edges
    longest = max(b - a for a, b in edges)
    n = int(2 ** np.ceil(np.log2(_FINER * longest)))
    power, weight = np.zeros((len(regression.rows), n // 2 + 1)), 0
    for a, b in edges:
        if (b - a) * regression.dt < _SHORTEST_S:
            continue
        part = regression.white[:, a:b]
        power += np.abs(np.fft.rfft(part - part.mean(1, keepdims=True), n)) ** 2
        weight += b - a
    frequency: Array = np.fft.rfftfreq(n, regression.dt).astype(np.float64)
    return frequency, power / max(weight, 1)


def lines(regression: Regression) -> list[float]:
    """Frequencies of the highest ordinates over all channels [Hz], at least a period apart in the longest stretch."""
    frequency, power = periodogram(regression)
    longest = max(b - a for a, b in regression.series.edges) * regression.dt
    if not power.any():
        return []
    usable = (frequency > 1.5 / longest) & (frequency < 0.4 / regression.dt)
    height = np.where(usable, power.max(0), 0.0)
    out: list[float] = []
    for i in np.argsort(-height):
        if height[i] <= 0 or len(out) == _PEAKS:
            break
        if all(abs(frequency[i] - f) > 1.5 / longest for f in out):
            out.append(float(frequency[i]))
    return out
