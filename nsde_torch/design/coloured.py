"""Noise with the spectrum of what a fit leaves, for machines whose gusts outweigh their sensors.

The law of a residual (`sysid.noise`) forgets within a second and is flat below: of gusts that last 0.7 s it has 0.5
times the power at 0.125 Hz and 1.5 times at 2 Hz (short flights of a simulated quadrotor). That serves to weigh rows.
Flights simulated with it are calmer than the measured ones, and the law that is then found of them is calmer again:
what an experiment tells came out as twice what was obtained. So noise is drawn with the periodogram itself,

    S(f) = sum over stretches |sum_k r_k exp(-2 pi i f k)|^2 / sum of their rows = Q(f) + R |1 - exp(-2 pi i f)|^2,

averaged over a band about each frequency in proportion to it, R the errors of the sensor, as large as leave Q >= 0 in
the upper half, and Q what acts on the machine (Percival and Walden, Spectral Analysis for Physical Applications, 1993).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_BAND = 1.3
"""Largest frequency of a band over its middle one."""
_LEAST = 2.0
"""Frequencies of the longest stretch that a band holds to either side, where that is more."""


def split_spectrum(residual: Array, edges: Sequence[tuple[int, int]], length: int) -> tuple[Array, float]:
    """What acts on a step by frequency (length // 2 + 1,), and the variance of the sensor.

    Args:
        residual: Residuals over steps (N,).
        edges: First row and the one behind the last of each stretch.
        length: Rows of the noise that is to be drawn, at least as many as those of the longest stretch.
    """
    power = np.sum([np.square(np.abs(np.fft.rfft(residual[a:b], length))) for a, b in edges], axis=0)
    power /= sum(b - a for a, b in edges)
    at = np.arange(len(power))
    least = _LEAST * length / max(b - a for a, b in edges)
    low = np.floor(np.minimum(at / _BAND, at - least)).clip(0).astype(int)
    high = np.ceil(np.maximum(at * _BAND, at + least)).clip(max=len(power) - 1).astype(int)
    total = np.concatenate(([0.0], np.cumsum(power)))
    smooth = (total[high + 1] - total[low]) / (high + 1 - low)
    differences = np.square(np.abs(1.0 - np.exp(-2j * np.pi * at / length)))
    upper = slice(len(at) // 2, None)
    sensor = float((smooth[upper] / differences[upper]).min())
    return np.maximum(smooth - sensor * differences, 0.0), sensor


def coloured(spectrum: Array, count: int, steps: int, length: int, rng: np.random.Generator) -> Array:
    """Normal noise (count, steps) of a spectrum (length // 2 + 1,)."""
    white = np.fft.rfft(rng.standard_normal((count, length)), axis=1)
    return np.fft.irfft(white * np.sqrt(spectrum), length, axis=1)[:, :steps]
