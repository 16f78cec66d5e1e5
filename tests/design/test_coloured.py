"""Noise with the spectrum of what a fit leaves: gusts that last keep their power, sensors theirs."""

from __future__ import annotations

import numpy as np

from nsde_torch.design.coloured import coloured, split_spectrum

DT, TAU, GUST, SENSOR = 0.01, 0.7, 0.15, 0.01  # s, s, m/s2, m/s
ROWS = 800
EDGES = ((0, ROWS), (ROWS, 2 * ROWS))
FIRST, LAST = 1, 9  # frequencies of a stretch: 0.125 to 1 Hz


def _residual(rng: np.random.Generator) -> np.ndarray:
    """What a slow gust (an exact Ornstein-Uhlenbeck step) and a velocity sensor leave of two stretches."""
    keep = np.exp(-DT / TAU)
    parts = []
    for _ in EDGES:
        g = np.empty(ROWS)
        g[0] = GUST * rng.standard_normal()
        for k in range(1, ROWS):
            g[k] = keep * g[k - 1] + GUST * np.sqrt(1 - keep**2) * rng.standard_normal()
        parts.append(DT * g + np.diff(SENSOR * rng.standard_normal(ROWS + 1)))
    return np.concatenate(parts)


def test_slow_gusts_keep_their_power_and_sensors_theirs() -> None:
    length, slow, sensors, drawn = 2 * ROWS, [], [], []
    f = np.arange(FIRST, LAST) / (ROWS * DT)
    true = float(np.mean(2 * TAU * DT * GUST**2 / (1 + np.square(2 * np.pi * f * TAU))))
    for seed in range(30):
        rng = np.random.default_rng(seed)
        spectrum, sensor = split_spectrum(_residual(rng), EDGES, length)
        slow.append(spectrum[2 * FIRST : 2 * LAST : 2].mean())
        sensors.append(sensor)
        noise = coloured(spectrum, 4, ROWS, length, rng)
        power = np.square(np.abs(np.fft.rfft(noise, axis=1))).mean(0) / ROWS
        drawn.append(power[FIRST:LAST].mean())
    assert 0.8 < np.mean(slow) / true < 1.25
    assert 0.8 < np.mean(drawn) / true < 1.25
    assert 0.6 < np.mean(sensors) / SENSOR**2 < 1.1


def test_white_pushes_without_a_sensor_stay_white() -> None:
    rng = np.random.default_rng(1)
    spectrum, sensor = split_spectrum(rng.standard_normal(4000), ((0, 4000),), 8000)
    noise = coloured(spectrum, 50, 1000, 8000, rng)
    whole = float(noise.var()) + 2.0 * sensor
    assert 0.9 < whole < 1.1
