"""What disturbs a machine, from the spectrum of what its physics leaves of every step.

    r_k = int d dt + sigma w_k + s (e_{k+1} - e_k),        d: Ornstein-Uhlenbeck, standard deviation std, time tau

    S(f) = h^2 std^2 (1 - a^2) / |1 - a exp(-i f)|^2 + sigma^2 h + s^2 |1 - exp(-i f)|^2,     a = exp(-h / tau)

sigma is a diffusion (per root second), s the white noise of the sensor. The law of r does not depend on how inputs
were made: what a controller answers is in the inputs, and physics has taken their effect out. The parameters have the
largest Whittle likelihood, sum_f log S + I / S over the periodogram I (Whittle, Arkiv foer Matematik 2 (1953)), which
is tapered by a sine: cut off sharply, the differences of a sensor's errors leak a floor that looks like a diffusion.
What physics lacks of slow forces is part of d: predictions err by it as by a gust.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from nsde_torch.arrays import Array
from nsde_torch.sysid.noise import Series

_BINS = 240
_LEAST = 1e-5  # of the residual's standard deviation: what is smaller is nothing
_LONGEST_S = 10.0
_FEWEST = 16  # rows of a stretch whose periodogram counts


@dataclass(frozen=True)
class Disturbance:
    """Law of the residual of one channel."""

    diffusion: float  # sigma [unit of the state per root second]
    std: float
    """Standard deviation of the lasting force [unit of the state per second]; 0 where there is none."""
    tau: float  # its correlation time [s]
    sensor: float  # standard deviation of the sensor [unit of the state]

    def without_memory(self, seconds: float) -> "Disturbance":
        """The law whose diffusion moves the state as far over some seconds as diffusion and force do here."""
        if not self.std > 0:
            return self
        share = self.tau / seconds
        force = 2.0 * self.std**2 * self.tau * (1.0 + share * np.expm1(-1.0 / share))
        return Disturbance(float(np.sqrt(self.diffusion**2 + force)), 0.0, self.tau, self.sensor)


@dataclass(frozen=True)
class Spectrum:
    """Periodogram in bins of about equal width in log frequency."""

    power: Array  # mean periodogram of each bin (bins,) [unit of the residual squared]
    angle: Array  # its frequency [rad a step]
    count: Array  # number of frequencies in it
    dt: float  # step [s]


def spectrum(columns: Array, series: Series, dt: float) -> Spectrum:
    """Spectrum of residuals (N, n), the mean of their columns."""
    angles, powers = [], []
    for a, b in series.edges:
        if b - a < _FEWEST:
            continue
        n = b - a
        taper = np.sqrt(2.0 / (n + 1)) * np.sin(np.pi * np.arange(1, n + 1) / (n + 1))
        wave = np.fft.rfft(columns[a:b] * taper[:, None], axis=0)[1:]
        powers.append(np.square(np.abs(wave)).mean(1))
        angles.append(2.0 * np.pi * np.arange(1, len(wave) + 1) / n)
    if not angles:
        variance = np.array([np.square(columns).mean()])
        return Spectrum(variance, np.array([0.5 * np.pi]), np.ones(1), dt)
    angle, power = np.concatenate(angles), np.concatenate(powers)
    edges = np.geomspace(angle.min(), np.pi, _BINS + 1)
    label = np.clip(np.searchsorted(edges, angle, side="right") - 1, 0, _BINS - 1)
    count = np.bincount(label, minlength=_BINS).astype(np.float64)
    live = count > 0
    total, place = (np.bincount(label, weights=v, minlength=_BINS)[live] for v in (power, angle))
    return Spectrum(total / count[live], place / count[live], count[live], dt)


def density(law: Disturbance, angle: Array, dt: float) -> Array:
    """Spectral density of the residuals of a law at some frequencies [rad a step]."""
    s = law.diffusion**2 * dt + law.sensor**2 * (2.0 - 2.0 * np.cos(angle))
    if law.std > 0:
        keep = np.exp(-dt / law.tau)
        s = s + (dt * law.std) ** 2 * (1.0 - keep**2) / (1.0 + keep**2 - 2.0 * keep * np.cos(angle))
    return np.asarray(s)


def fit(seen: Sequence[Spectrum], *, lasting: bool, shortest: float) -> Disturbance:
    """Law of largest Whittle likelihood.

    Args:
        seen: Spectra of channels that share one law.
        lasting: Whether there is a lasting force.
        shortest: Least correlation time [s].
    """
    power, angle, count = (np.concatenate([getattr(s, k) for s in seen]) for k in ("power", "angle", "count"))
    h = seen[0].dt
    size = float(np.sqrt((power * count).sum() / count.sum()))
    if not size > 0:
        return Disturbance(0.0, 0.0, shortest, 0.0)
    low, high = np.log(_LEAST * size), np.log(30.0 * size)
    root = np.sqrt(h)

    def law(p: Array) -> Disturbance:
        std, tau = (np.exp(p[2]) / h, np.exp(p[3])) if lasting else (0.0, shortest)
        return Disturbance(float(np.exp(p[0]) / root), float(std), float(tau), float(np.exp(p[1])))

    def cost(p: Array) -> float:
        s = density(law(p), angle, h)
        return float((count * (np.log(s) + power / s)).sum() / count.sum())

    bounds = [(low, high), (low, high)]
    middle = np.log(size)
    starts = [[middle, middle - 1.0], [middle - 2.0, middle], [middle - 4.0, middle]]
    if lasting:
        bounds += [(low, high), (np.log(shortest), np.log(_LONGEST_S))]
        starts = [
            [*start, lasts, time]
            for start in starts
            for lasts in (middle - 1.0, middle - 3.0)
            for time in (np.log(1.5 * shortest), np.log(1.0))
        ]
    best = min(
        (minimize(cost, np.array(s), method="L-BFGS-B", bounds=bounds) for s in starts),
        key=lambda r: float(r.fun),
    )
    return law(best.x)
