"""Filters that states went through before they were logged, by what they leave of the sensors' noise.

A chain that smooths logs x_log = S (x + e): the motion x and the white noise e of a sensor, both through a smoother S.
Where the noise is most of the residual, the spectrum of the log is that of S itself,

    P(f) = |S(f)|^2 (sum_m a_m f^-m + s) + q,      m = 2, 4, 6, 8

with a motion whose spectrum falls by powers of the frequency, a sensor that is white (s), and the rounding behind the
smoother (q). A rate that is the derivative of a polynomial through positions (Savitzky and Golay, 1964) is a smoothed
rate too, S = D(f) / (2 pi i f), with s + s' f^2 instead of s. For a given S the weights a_m, s, q >= 0 are those of
the largest Whittle likelihood of the periodograms I(f), the mean of K windows, - K sum_f (log P(f) + I(f) / P(f)), by
multiplicative steps (Fevotte, Bertin and Durrieu, Neural Computation 21 (2009)). What the fit lacks is given as its
deviance per bin, K (I / P - 1 - log(I / P)) on average, about 0.5 for a spectrum of this form.

Windows are Kaiser's with sidelobes of -150 dB: behind a steep smoother a spectrum spans ten decades and more. Their
main lobe is twelve bins wide, so P is fitted as windows see it, sum_g L(f, g) P(g): without this, windows of 128 rows
place a cut-off at 6 of 100 Hz a quarter too high.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import log, pi
from typing import Any

import numpy as np
from numpy.fft import fft, irfft, rfft, rfftfreq
from numpy.polynomial import polynomial
from numpy.typing import NDArray
from scipy.signal import get_window, savgol_coeffs

from nsde_torch.arrays import Array
from nsde_torch.recording.smoothing import mean_weights

Complex = NDArray[np.complex128]

_POWERS = (2, 4, 6, 8)
_WINDOW, _SHORTEST, _FEWEST = 512, 128, 4  # rows of a window at most and at least, and windows
_BETA = 20.0  # of Kaiser's window
_FIRST = 6  # bins of the lowest frequencies, which a trend and the window's main lobe fill
_KEPT = slice(_FIRST, -2)
_FINER = 4  # frequencies for each bin of a window, which sees twelve bins at once
_FLAT = 3  # bins below which a motion is flat, half of the first: a trend is taken out of each window
_EFFECTIVE = 0.6  # independent windows for each half-overlapping one
_DAMPED = 0.7  # exponent of a multiplicative step, which keeps it from oscillating
_ROUGH, _FINE, _LAST = 40, 100, 400
"""Steps of a fit in the search, near its best, and of the one that is judged."""
_ZOOMS = (1.1, 1.04, 1.012, 1.004, 1.0015)
_NEAR, _NEAR_SHARE = 0.1, 0.5
"""Deviance by which another smoother may be worse and still be likely: at least, and as a share of the best's."""
_TYPICAL = 0.3  # deviance where the form is right
_AGREE = 0.1  # of the gain
_SLOW = 1e-3  # of the rate of the log, at which a delay is read off the phase
_SAME = 0.03  # deviance by which smoothers are alike
_VANISHES, _RETURNS = 0.02, 0.05  # |S| at a zero, and between two
_NO_WORSE = 0.1  # deviance that noise alone may be worse than noise and motion where no input moves
_WIDEST = 75  # rows of the widest moving average or Savitzky-Golay filter


@dataclass(frozen=True)
class Family:
    """Smoothers of one kind."""

    name: str
    response: Callable[[Array, float, int, float], Complex]
    """S (F,) at frequencies [Hz], of a size (cut-off at half amplitude [Hz], or rows), an order and a step."""
    orders: tuple[int, ...]
    of_rows: bool = False  # whether the size is a number of rows
    delays: bool = False  # whether it is causal
    differentiates: bool = False  # whether it makes rates of positions; nothing but a rate can be behind it


@dataclass(frozen=True)
class Smoother:
    """One smoother."""

    family: Family
    order: int
    size: float  # cut-off [Hz], or rows
    dt: float  # step of the log [s]

    def response(self, f: NDArray[Any]) -> Complex:
        """S (F,) at frequencies [Hz]."""
        return self.family.response(np.asarray(f, dtype=np.float64), self.size, self.order, self.dt)

    @property
    def delay(self) -> float:
        """How late it makes slow motions [s]; 0 for one that is not causal."""
        f = _SLOW / self.dt
        return float(-np.angle(self.response(np.array([f])))[0] / (2.0 * pi * f))

    def falls_to(self, level: float) -> float:
        """The lowest frequency at which |S| is below a level [Hz]; half the rate where it never is."""
        f = np.linspace(0.0, 0.499 / self.dt, 2000)
        below = np.flatnonzero(np.abs(self.response(f)) < level)
        return float(f[below[0]]) if len(below) else float(f[-1])

    @property
    def vanishes_between(self) -> bool:
        """Whether |S| vanishes at some frequency and returns above it, as that of a mean does."""
        level = np.abs(self.response(np.linspace(0.0, 0.5 / self.dt, 2000)))
        return bool(level[int(np.argmax(level < _VANISHES)) :].max() > _RETURNS and level.min() < _VANISHES)

    def __str__(self) -> str:
        order = f" of order {self.order}" if len(self.family.orders) > 1 else ""
        size = f"{self.size:.0f} rows" if self.family.of_rows else f"{self.size:.3g} Hz"
        return f"a {self.family.name}{order}, {size}"


@dataclass(frozen=True)
class Spectra:
    """Periodograms of some channels."""

    f: Array  # frequencies (F,) [Hz]
    power: Array  # mean periodograms (C, F) [unit^2 / Hz]
    windows: float  # number of independent windows
    dt: float
    fine: Array  # frequencies (G,) that a bin sees more than one of [Hz]
    lobe: Array  # what the window lets each bin see of them (G, F); of a constant, that constant
    moves: bool = True  # whether there may be motion, and not only noise

    def above(self, f: float) -> "Spectra":
        """The bins from a frequency [Hz] on."""
        kept = self.f >= f
        return replace(self, f=self.f[kept], power=self.power[:, kept], lobe=self.lobe[:, kept])


@dataclass(frozen=True)
class SpectrumFit:
    """The spectrum of a log behind a smoother."""

    deviance: float  # per bin; about 0.5 where the form is right
    motion: Array  # spectra before the smoother without the sensor's noise (C, F) [unit^2 / Hz]
    noise: Array  # the sensor's noise before the smoother (C, F) [unit^2 / Hz]
    rounding: Array  # what rounding adds behind it (C,) [unit^2 / Hz]


def _warped(f: Array, dt: float) -> Array:
    return np.asarray(np.tan(pi * dt * np.minimum(f, 0.4999 / dt)))


def _two_ways(f: Array, size: float, order: int, dt: float) -> Complex:
    ratio = _warped(f, dt) / np.tan(pi * size * dt)
    return np.asarray(1.0 / (1.0 + ratio ** (2 * order)), dtype=np.complex128)


def _one_way(f: Array, size: float, order: int, dt: float) -> Complex:
    poles = np.exp(1j * pi * (2 * np.arange(1, order + 1) + order - 1) / (2 * order))
    s = 1j * _warped(f, dt) / np.tan(pi * size * dt)
    return np.asarray(np.prod(-poles).real / np.prod(s[:, None] - poles, axis=1))


def _spline(f: Array, size: float, order: int, dt: float) -> Complex:
    ratio = np.sin(pi * f * dt) / np.sin(pi * size * dt)
    return np.asarray(1.0 / (1.0 + ratio ** (2 * order)), dtype=np.complex128)


def _cubic_spline(f: Array, size: float, order: int, dt: float) -> Complex:
    def roughness(g: Array) -> Array:  # of a natural cubic spline on a unit grid (Reinsch, 1967)
        return np.asarray(np.sin(pi * g * dt) ** 4 / (2.0 + np.cos(2 * pi * g * dt)))

    return np.asarray(1.0 / (1.0 + roughness(f) / roughness(np.array([size]))), dtype=np.complex128)


def _weighted(f: Array, weights: Array, dt: float) -> Complex:
    """Response of symmetric weights over rows about each row."""
    half = len(weights) // 2
    waves = np.cos(2 * pi * dt * np.outer(f, np.arange(-half, half + 1)))
    return np.asarray(waves @ weights, dtype=np.complex128)


def _gaussian(f: Array, size: float, order: int, dt: float) -> Complex:
    std = (2.0 * log(2.0)) ** 0.5 / (2 * pi * size * dt)
    half = max(1, int(order * std + 0.5))  # cut off at so many standard deviations
    weights = np.exp(-0.5 * (np.arange(-half, half + 1) / std) ** 2)
    return _weighted(f, weights / weights.sum(), dt)


def _mean(f: Array, size: float, order: int, dt: float) -> Complex:
    return _weighted(f, mean_weights(round(size)), dt)


def _mean_of_past(f: Array, size: float, order: int, dt: float) -> Complex:
    return np.asarray(np.exp(-2j * pi * dt * np.outer(f, np.arange(round(size)))).mean(1))


def _savitzky_golay(f: Array, size: float, order: int, dt: float) -> Complex:
    return _weighted(f, np.asarray(savgol_coeffs(round(size), order)), dt)


def _savitzky_golay_slope(f: Array, size: float, order: int, dt: float) -> Complex:
    half = round(size) // 2
    weights = np.asarray(savgol_coeffs(2 * half + 1, order, deriv=1, delta=dt, use="dot"))
    turn = 2 * pi * np.maximum(f, 1e-6 / dt)
    waves = np.sin(np.outer(turn, dt * np.arange(-half, half + 1)))
    return np.asarray(waves @ weights / turn, dtype=np.complex128)


CENTRED, OF_THE_PAST = "moving average", "causal moving average"
FAMILIES = (
    Family("Butterworth filter forwards and backwards", _two_ways, (1, 2, 3, 4, 5, 6, 8)),
    Family("causal Butterworth filter", _one_way, (1, 2, 3, 4), delays=True),
    Family("Kalman smoother", _spline, (1, 2, 3)),
    Family("cubic smoothing spline", _cubic_spline, (2,)),
    Family("Gaussian filter", _gaussian, (3, 4, 6)),
    Family(CENTRED, _mean, (0,), of_rows=True),
    Family(OF_THE_PAST, _mean_of_past, (0,), of_rows=True, delays=True),
    Family("Savitzky-Golay filter", _savitzky_golay, (2, 4), of_rows=True),
    Family("Savitzky-Golay derivative", _savitzky_golay_slope, (2, 4), of_rows=True, differentiates=True),
)
"""Smoothers that are tried. A causal filter of order 2 n looks like one of order n forwards and backwards; steep ones
are taken for the latter."""


def spectra_of(parts: Sequence[Array], dt: float) -> Spectra | None:
    """Spectra of stretches (n, C) of rows, each window without its trend; None where they are too short."""
    longest = max((len(part) for part in parts), default=0)
    if longest < _SHORTEST:
        return None
    rows = _WINDOW if longest >= 3 * _WINDOW else max(_SHORTEST, 2 ** int(np.log2(longest // 3)))
    taper, t = _taper(rows), np.linspace(-1.0, 1.0, rows)
    squares = []
    for part in parts:
        for a in range(0, len(part) - rows + 1, rows // 2):
            cut = part[a : a + rows]
            cut = cut - polynomial.polyval(t, polynomial.polyfit(t, cut, 1)).T
            squares.append(np.square(np.abs(rfft(taper[:, None] * cut, axis=0))))
    if len(squares) < _FEWEST:
        return None
    power = np.mean(squares, axis=0).T * (2.0 * dt / np.square(taper).sum())
    f, fine = (np.asarray(rfftfreq(n, dt), dtype=np.float64) for n in (rows, _FINER * rows))
    return Spectra(f[_KEPT], power[:, _KEPT], _EFFECTIVE * len(squares), dt, fine[1:], _lobe(rows))


def _taper(rows: int) -> Array:
    return np.asarray(get_window(("kaiser", _BETA), rows))


@lru_cache
def _lobe(rows: int) -> Array:
    """The mean periodogram in each bin (G, F) of a unit of power at each part of a bin; the same array each time."""
    fine = _FINER * rows
    seen = np.square(np.abs(fft(_taper(rows), fine)))  # by offset in parts of a bin, once around
    bins, parts = _FINER * np.arange(rows // 2 + 1)[_KEPT], np.arange(1, fine // 2 + 1)
    lobe = seen[np.abs(bins - parts[:, None])] + seen[(bins + parts[:, None]) % fine]
    return np.asarray(lobe / lobe.sum(0))


def fit(seen: Spectra, smoother: Smoother | None, *, steps: int = _LAST) -> SpectrumFit:
    """Fit spectra behind a smoother; None for none."""
    gain = np.ones_like(seen.fine) if smoother is None else np.square(np.abs(smoother.response(seen.fine)))
    of_position = [2.0] if smoother is not None and smoother.family.differentiates else []
    motion = [-1.0 * m for m in _POWERS] if seen.moves else []
    powers = [*motion, 0.0, *of_position]
    bin_hz, middle = seen.f[1] - seen.f[0], seen.f[len(seen.f) // 8]

    def shapes(f: Array) -> Array:
        relative = np.maximum(f, _FLAT * bin_hz) / middle
        return np.stack([relative**p for p in powers])

    before = shapes(seen.f)
    base = np.concatenate([(shapes(seen.fine) * gain) @ seen.lobe, np.ones((1, len(seen.f)))])
    weights = np.maximum((seen.power[:, None] / np.maximum(base, 1e-300)).min(2), 1e-40)
    for _ in range(steps):
        model = weights @ base
        weights = weights * (((seen.power / model**2) @ base.T) / ((1.0 / model) @ base.T)) ** _DAMPED
    ratio = seen.power / (weights @ base)
    deviance = seen.windows * float((ratio - 1.0 - np.log(ratio)).mean())
    m = len(motion)
    return SpectrumFit(deviance, weights[:, :m] @ before[:m], weights[:, m:-1] @ before[m:], weights[:, -1])


class Stretch:
    """Values (n,) of one stretch at a step `dt` [s], to go through filters."""

    def __init__(self, values: Array, dt: float) -> None:
        self._count, self._around = len(values), min(len(values) - 1, 200)
        around = self._around
        longer = np.concatenate([values[around:0:-1], values, values[-2 : -around - 2 : -1]])
        self._length, self._f = len(longer), rfftfreq(len(longer), dt)
        self._spectrum = rfft(longer)

    def through(self, smoother: Smoother | None, lag: float, delay: float) -> Array:
        """The values (n,) behind a lag of first order and a delay [s], and a smoother."""
        response: NDArray[Any] = np.exp(-2j * np.pi * self._f * delay) / (1.0 + 2j * np.pi * self._f * lag)
        if smoother is not None:
            response = response * smoother.response(self._f)
        through = irfft(np.multiply(self._spectrum, response), self._length)
        return np.asarray(through[self._around : self._around + self._count])


@dataclass(frozen=True)
class Likely:
    """Smoothers behind which spectra are likeliest: the best, and those of other kinds that fit nearly as well."""

    smoother: Smoother
    deviance: float
    others: tuple[Smoother, ...]

    @property
    def agree_to(self) -> float:
        """Frequency up to which all of them have nearly the same gain [Hz]."""
        f = np.linspace(0.0, 0.499 / self.smoother.dt, 2000)
        own = np.abs(self.smoother.response(f))
        ends = [np.flatnonzero(np.abs(np.abs(o.response(f)) - own) > _AGREE * own) for o in self.others]
        return float(f[min((end[0] for end in ends if len(end)), default=len(f) - 1)])


def likeliest(seen: Spectra, *, rates: bool = False) -> Likely:
    """The smoothers of all families behind which spectra, or `rates`, which may be made of positions, are likeliest.

    Spectra hold no phase: where one without delay fits as well as the likeliest, it is taken. A delay that was
    there then stays in the log; one that was not would make it know the future.
    """
    tried = []
    for family in (family for family in FAMILIES if rates or not family.differentiates):
        for order in family.orders:
            smoother = _likeliest_of(family, order, seen)
            tried.append((fit(seen, smoother).deviance, smoother))
    tried.sort(key=lambda one: one[0])
    near = tried[0][0] + max(_NEAR, _NEAR_SHARE * (tried[0][0] - _TYPICAL))
    likely = [one for one in tried if one[0] < near]
    as_good = [one for one in likely if one[0] < tried[0][0] + _SAME]
    deviance, best = next((one for one in as_good if not one[1].family.delays), likely[0])
    return Likely(best, deviance, tuple(other for _, other in likely if other is not best))


def without_motion(seen: Sequence[Spectra]) -> list[Spectra]:
    """Spectra above all that inputs do, as of noise alone where that is no worse behind the smoothers of each.

    With a motion that may be there, 16.3 Hz fitted a filter of 12 Hz
    (tests/sysid/test_smoothed_states.py::test_a_motion_under_a_few_waves_does_not_hide_the_filter).
    """
    alone = [replace(one, moves=False) for one in seen]
    pairs = zip(alone, seen, strict=True)
    enough = all(likeliest(a).deviance < likeliest(b).deviance + _NO_WORSE for a, b in pairs)
    return alone if enough else list(seen)


def _likeliest_of(family: Family, order: int, seen: Spectra) -> Smoother:
    """The size of the largest likelihood among smoothers of one family and order: a grid, then nearer and nearer."""

    def deviance(size: float, steps: int) -> float:
        return fit(seen, Smoother(family, order, size, seen.dt), steps=steps).deviance

    half = 0.5 / seen.dt
    if family.of_rows:
        sizes = range(2, _WIDEST) if not order else range((order + 3) | 1, _WIDEST, 2)
        return Smoother(family, order, float(min(sizes, key=lambda n: deviance(n, _ROUGH))), seen.dt)
    near = min((deviance(size, _ROUGH), size) for size in np.geomspace(half / 60.0, 0.8 * half, 18).tolist())
    for zoom in _ZOOMS:
        around = [near[1] * zoom**k for k in (-1.5, -0.7, 0.0, 0.7, 1.5)]
        near = min((deviance(size, _FINE), size) for size in around if size < 0.95 * half)
    return Smoother(family, order, near[1], seen.dt)
