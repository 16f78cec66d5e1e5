"""Springs, carts and joints whose position alone is measured: simulators that share no code with the package.

    spring    q'' = -k q - b v + g u + what a case holds                                 (over mass)
    cart      a = u / M + s l w^2 sin(theta) + what a case holds,   s = m / M
              w' = (G sin(theta) - a cos(theta)) / (l (4/3 - s cos(theta)^2)),   x'' = a - s l w' cos(theta)
    joints    `examples/double_pendulum/make_data.py`

by Runge-Kutta 4 at a fraction of the log's step, inputs held over a row; gusts are white. Encoders have white noise or
count in steps. Rates are those of a user: none, np.gradient, the difference from the row before, a Savitzky-Golay or
Butterworth filter of the position.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, lfilter, savgol_filter

Array = NDArray[np.float64]
Law = Callable[[float, float], float]
G = 9.8
RATES = ("none", "gradient", "backward", "savgol", "butterworth")


def rates(q: Array, dt: float, how: str) -> Array:
    """Rates that a user makes of a position column (n,)."""
    if how == "gradient":
        return np.asarray(np.gradient(q, dt))
    if how == "backward":
        return np.diff(q, prepend=q[0]) / dt
    if how == "savgol":
        return np.asarray(savgol_filter(q, 11, 3, deriv=1, delta=dt))
    b, a = butter(2, 10.0 * 2.0 * dt)
    return np.asarray(lfilter(b, a, np.gradient(q, dt)))


def measured(q: Array, noise: float, counts: bool, rng: np.random.Generator) -> Array:
    """An encoder's reading: white noise of this size, or steps that round by as much (root mean square)."""
    if not counts:
        return np.asarray(q + noise * rng.standard_normal(q.shape))
    step = noise * np.sqrt(12.0)
    return np.asarray(np.round(q / step) * step)


def sums_of_sines(t: Array, size: float, rng: np.random.Generator, low: float, high: float) -> Array:
    """A force (n,) of this standard deviation."""
    hertz = np.exp(rng.uniform(np.log(low), np.log(high), 8))
    phase = rng.uniform(0.0, 2.0 * np.pi, 8)
    return np.asarray(size / 2.0 * np.sin(2.0 * np.pi * hertz * t[:, None] + phase).sum(1))


def spring(
    values: dict[str, float],
    law: Law,
    *,
    seconds: float,
    dt: float,
    gust: float,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """True states (n, 2) and forces (n, 1)."""
    t = dt * np.arange(round(seconds / dt))
    u = sums_of_sines(t, values["force"], rng, 0.08, 1.5)
    k, b, g = values["k"], values["b"], values["g"]

    def rate(y: Array, push: float) -> Array:
        q, v = float(y[0]), float(y[1])
        return np.array([v, -k * q - b * v + push + law(q, v)])

    return _integrated(rate, g * u, np.zeros(2), dt, gust, rng), u[:, None]


def cart(
    values: dict[str, float],
    law: Law,
    *,
    seconds: float,
    dt: float,
    gust: float,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """True states (n, 4) and forces (n, 1); the pole hangs, and a soft spring of the force keeps the cart near 0."""
    t = dt * np.arange(round(seconds / dt))
    u = sums_of_sines(t, values["force"], rng, 0.15, 1.5)
    g, s, half = values["g"], values["s"], values["l"]

    def rate(y: Array, push: float) -> Array:
        x, v, theta, w = (float(c) for c in y)
        sin, cos = np.sin(theta), np.cos(theta)
        a = push + s * half * w * w * sin + law(x, v)
        turn = (G * sin - a * cos) / (half * (4.0 / 3.0 - s * cos * cos))
        return np.array([v, a - s * half * turn * cos, w, turn])

    start = np.array([0.0, 0.0, np.pi + rng.uniform(-0.6, 0.6), 0.0])
    return _integrated(rate, g * u, start, dt, gust, rng), u[:, None]


def _integrated(
    rate: Callable[[Array, float], Array],
    push: Array,
    start: Array,
    dt: float,
    gust: float,
    rng: np.random.Generator,
) -> Array:
    fine = max(1, int(np.ceil(dt / 0.002)))
    h, y, out = dt / fine, start, np.empty((len(push), len(start)))
    for n in range(len(push)):
        out[n] = y
        for _ in range(fine):
            f = push[n] + gust * rng.standard_normal() / np.sqrt(h)
            k1 = rate(y, f)
            k2 = rate(y + 0.5 * h * k1, f)
            k3 = rate(y + 0.5 * h * k2, f)
            k4 = rate(y + h * k3, f)
            y = y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return out
