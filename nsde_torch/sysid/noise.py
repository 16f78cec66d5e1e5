"""The noise of one channel of residuals, and the filter that makes it white.

A residual over a step holds the difference of two errors of the sensor, and whatever the physics lacks: gusts, which
last. Its law is taken as

    (1 + a_1 B + ... + a_p B^p) r_k = (1 - c B) e_k,      B r_k = r_{k-1},      e white

(an autoregression for what lasts, a moving average for the sensor). Dividing by 1 - c B sums residuals up: what is
compared then is the state itself, and not its change. The test function of a whitened row is thus a staircase
that looks back as far as noise allows. Whitening is causal, so that a whitened row knows no input that reacts to it:
that is what keeps feedback from bending the estimate (Ljung, System Identification, 1999, section 13.4).

Second differences of a position, which stand for a rate that no sensor measured, hold its error three times: their
moving average is (1 - c B)^2.

How each is found:

- c, p: least Akaike score of the exact likelihood of the moving average with the error e before the first row for
  an unknown of its own; c is at most `limit`, which follows from noise that is known to be there.
- a: Burg's method over all stretches, as reflection coefficients; rows near a start use the lower orders. Then a_j is
  multiplied by exp(-j / m): noise forgets within m rows. What lasts longer, as thrust that falls from take-off to
  landing, must not pass for noise: rows would be weighed as if they knew nothing of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, log

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from nsde_torch.sysid.series import Series

Array = NDArray[np.float64]

_GRID = 1.0 - np.array([1, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12, 0.08, 0.05, 0.03, 0.02, 0.012, 0.008, 0.005])
_AKAIKE = 2.0
_FADED = -40.0  # log of what is nothing
_DIGITS = 1e-7  # share of the variance below which sums of products have lost too many digits
_ROUNDING = 1e-10  # SI units a step: what double precision leaves of states of everyday size


@dataclass(frozen=True)
class Noise:
    """Law of the noise of one channel."""

    carry: float  # c, in [0, 1)
    reflection: Array  # reflection coefficients of the autoregression (p,)
    std: float  # standard deviation of e [unit of the residual]
    times: int = 1  # how many times 1 - c B is there: 2 for second differences

    @property
    def parameters(self) -> int:
        """Number of parameters besides the size."""
        return len(self.reflection) + (self.carry > 0)

    @property
    def polynomial(self) -> Array:
        """Coefficients 1, a_1, ..., a_p of the autoregression (p + 1,)."""
        return _polynomial(self.reflection)

    def likelihood(self, rows: int) -> float:
        """Log likelihood of rows that it was fitted to, less one for each of its parameters (Akaike)."""
        return -rows * log(self.std) - self.parameters

    def whiten(self, values: Array, series: Series) -> Array:
        """Filtered columns (N, k) in units of `std`, one row more per stretch than there were: (N + stretches, k)."""
        summed = _carry(self.carry, values, series, self.times)
        return _filtered(self.reflection, summed, extended(series)) / self.std

    def log_density(self, white: Array, series: Series) -> Array:
        """Log density of each row of a column of `whiten` (N + stretches,) [nat], less the constant log(2 pi) / 2.

        The row before each stretch has no density of its own: what it holds is what the unknown error before the first
        row costs, -log det / 2 of the moving average; rows near a start are as uncertain as their lower order leaves.
        """
        longer = extended(series)
        kept = np.cumsum(np.append(0.0, np.log1p(-np.square(self.reflection))))
        near = 0.5 * (kept[-1] - kept[np.minimum(longer.place, len(self.reflection))])
        out = -0.5 * np.square(white) - log(self.std) + near
        c = self.carry
        for a, b in longer.edges:
            spread = np.log((1 - c ** (2 * (b - a))) / (1 - c * c)) if c > 0 else 0.0
            out[a] = -0.5 * white[a] ** 2 - 0.5 * self.times * spread
        return np.asarray(out)

    def own_slopes(self, residual: Array, series: Series) -> Array:
        """Slopes of the whitened residual (N,) in a and c, (N + stretches, p + 1), up to factors."""
        longer = extended(series)
        summed = _carry(self.carry, residual[:, None], series, self.times)
        columns = [longer.lagged(summed, range(1, len(self.reflection) + 1))]
        if self.carry > 0:
            white = _filtered(self.reflection, summed, longer)[:, 0]
            of_carry = np.zeros(len(longer))
            for a, b in longer.edges:
                of_carry[a + 1 : b] = lfilter([1.0], [1.0, -self.carry], white[a:b])[:-1]
            columns.append(of_carry[:, None])
        return np.concatenate(columns, 1)


def extended(series: Series) -> Series:
    """Series of whitened rows: the error before the first row of a stretch is a row of its own."""
    return Series(tuple((a + i, b + i + 1) for i, (a, b) in enumerate(series.edges)))


def white_noise(residual: Array, series: Series) -> Noise:
    """Noise that is white."""
    return Noise(0.0, np.zeros(0), _size(residual, len(series)))


def first_guess(residual: Array, series: Series, limit: float, *, times: int = 1) -> Noise:
    """Noise of a sensor alone: what to start with, as it weighs slow motion most."""
    carry = min(limit, 0.98)
    summed = _carry(carry, residual[:, None], series, times)[:, 0]
    return Noise(carry, np.zeros(0), _size(summed, len(series)), times)


def estimate(
    residual: Array,
    series: Series,
    *,
    limit: float,
    orders: int,
    memory: float = inf,
    among: Sequence[float] | None = None,
    times: int = 1,
) -> Noise:
    """Law of the noise of residuals (N,).

    Args:
        limit: Largest c.
        orders: Largest order of the autoregression.
        memory: Rows after which noise forgets (m).
        among: Values of c to choose from; None tries all.
        times: How many times 1 - c B is there.
    """
    grid = np.append(_GRID[limit > _GRID], limit) if among is None else np.array(among)
    scores = {c: _score(residual, series, c, orders, times) for c in grid.tolist()}
    if among is None:
        at = int(np.abs(grid - min(scores, key=lambda c: scores[c][0])).argmin())
        for c in np.linspace(grid[max(at - 1, 0)], grid[min(at + 1, len(grid) - 1)], 7)[1:-1].tolist():
            scores[c] = _score(residual, series, c, orders, times)
    carry = min(scores, key=lambda c: (scores[c][0], c))
    return _law(residual, series, carry, scores[carry][1], memory, times)


def again(noise: Noise, residual: Array, series: Series, *, memory: float = inf) -> Noise:
    """A law of the same order and the same c for other residuals (N,)."""
    summed = _carry(noise.carry, residual[:, None], series, noise.times)[:, 0]
    reflection, _ = _burg(summed, extended(series), len(noise.reflection))
    return _law(residual, series, noise.carry, reflection, memory, noise.times)


def _law(
    residual: Array, series: Series, carry: float, reflection: Array, memory: float, times: int
) -> Noise:
    reflection = forgetting(reflection, memory)
    white = _filtered(reflection, _carry(carry, residual[:, None], series, times), extended(series))
    return Noise(carry, reflection, _size(white, len(series)), times)


def forgetting(reflection: Array, memory: float) -> Array:
    """Reflection coefficients (p,) of the autoregression whose coefficients are multiplied by exp(-j / memory)."""
    a = _polynomial(reflection)
    a = a * np.exp(-np.arange(len(a)) / memory)
    out = np.zeros(len(reflection))
    with np.errstate(
        divide="ignore", invalid="ignore"
    ):  # nothing new is left: nan, which a regression refuses
        for m in range(len(reflection), 0, -1):
            out[m - 1] = a[m]
            a = (a[:m] - a[m] * a[:0:-1]) / (1.0 - a[m] ** 2)
    out[np.abs(out) >= 1.0] = np.nan
    return out


def carry_limit(own: float, known: float, std: float, dt: float) -> float:
    """The largest c: that of a sensor of standard deviation `std` and the noise that it brings into f.

    r_k = e_{k+1} - e_k - h s (e_{k+1} + e_k) / 2 + w_k has autocovariances whose ratio gives c, with `own` the mean
    slope s of the channel's rate in the channel itself [1/s], `known` the standard deviation of w, which the noise of
    the other channels adds to a step [unit of the channel], and `dt` the step h [s].
    """
    if not std > 0:
        return 0.0
    a = min(abs(own * dt / 2), 0.9)
    beyond = (2 * (1 + a * a) + (known / std) ** 2) / (1 - a * a) - 2
    return float(np.clip(1 + beyond / 2 - np.sqrt(beyond + beyond**2 / 4), 0.0, 1.0 - 1e-4))


def _size(white: Array, rows: int) -> float:
    return max(float(np.sqrt(np.square(white).sum() / rows)), _ROUNDING)


def _score(residual: Array, series: Series, carry: float, orders: int, times: int) -> tuple[float, Array]:
    """Akaike score with the best order of the autoregression, and its reflection coefficients."""
    summed = _carry(carry, residual[:, None], series, times)[:, 0]
    reflection, left = _burg(summed, extended(series), orders)
    spread = times * sum(np.log((1 - carry ** (2 * (b - a + 1))) / (1 - carry**2)) for a, b in series.edges)
    scores = len(residual) * np.log(left) + spread + _AKAIKE * (np.arange(len(left)) + (carry > 0))
    order = int(np.argmin(scores))
    return float(scores[order]), reflection[:order]


def _carry(c: float, values: Array, series: Series, times: int) -> Array:
    """Columns (N, k) over (1 - c B)^times, with the error before each stretch estimated and put in front."""
    for _ in range(times - 1):
        values = np.delete(_carry(c, values, series, 1), [a + i for i, (a, _) in enumerate(series.edges)], 0)
    out = np.empty((len(values) + len(series.edges), values.shape[1]), order="F")
    for i, (a, b) in enumerate(series.edges):
        at, n = a + i, b - a
        if c == 0:
            out[at], out[at + 1 : at + 1 + n] = 0.0, values[a:b]
            continue
        summed = lfilter([1.0], [1.0, -c], values[a:b], axis=0)
        live = min(
            n, int(_FADED / np.log(c)) + 1
        )  # rows after which the error before the first no longer counts
        fading = c ** np.arange(1, live + 1)
        before = fading @ summed[:live] / (1.0 + fading @ fading)
        out[at], out[at + 1 : at + 1 + n] = -before, summed
        out[at + 1 : at + 1 + live] -= np.outer(fading, before)
    return out


def _burg(values: Array, series: Series, orders: int) -> tuple[Array, Array]:
    """Reflection coefficients (orders,) and the variance left after each order (orders + 1,).

    Errors of prediction are quadratic forms of the autoregression's coefficients in sums of lagged products, which are
    made once (Vos, A fast implementation of Burg's method, 2013). Where next to nothing is left, these sums do not hold
    enough digits, and the errors themselves are filtered.
    """
    left = [max(float(np.square(values).mean()), 1e-300)]
    reflection: list[float] = []
    a = np.ones(1)
    for products in _lagged_products(values, series, orders):
        forward = np.append(a, 0.0)
        backward = forward[::-1]
        of_forward, of_backward = products @ forward, products @ backward
        size = float(forward @ of_forward + backward @ of_backward)
        k = float(-2.0 * (backward @ of_forward) / size) if size > 0 else 0.0
        reflection.append(k)
        left.append(max(left[-1] * (1.0 - k * k), 1e-300))
        a = forward + k * backward
    if left[-1] < _DIGITS * left[0]:
        return _burg_filtered(values, series, orders)
    return np.array(reflection), np.array(left)


def _lagged_products(values: Array, series: Series, orders: int) -> list[Array]:
    """For m = 1 ... orders: sums over k >= m of r_{k-i} r_{k-j} in each stretch, i, j = 0 ... m (m + 1, m + 1)."""
    stretches = [values[a:b] for a, b in series.edges]
    lags = np.zeros(orders + 1)
    ends = np.zeros((orders + 1, orders + 1))
    for r in stretches:
        if len(r) > orders > 0:
            lags += np.correlate(r, r[orders:], "valid")[::-1]
            first, last = r[orders - 1 :: -1], r[: -orders - 1 : -1]
            ends[1:, 1:] += np.outer(first, first) - np.outer(last, last)
    # element (i, j) is element (i - 1, j - 1) and what comes in and goes out at the ends: sums along diagonals
    i, j = np.indices(ends.shape)
    skewed = np.where(i + j <= orders, ends[i, np.minimum(i + j, orders)], 0.0).cumsum(0)
    total = lags[np.abs(i - j)] + skewed[np.minimum(i, j), np.abs(i - j)]
    out = [total]
    heads = np.zeros((len(stretches), orders + 1))
    lengths = np.array([len(r) for r in stretches])
    for row, r in zip(heads, stretches, strict=True):
        row[: min(len(r), orders + 1)] = r[: orders + 1]
    for m in range(orders - 1, 0, -1):
        head = heads[lengths > m, m::-1]
        out.append(out[-1][: m + 1, : m + 1] + head.T @ head)
    return out[::-1] if orders else []


def _burg_filtered(values: Array, series: Series, orders: int) -> tuple[Array, Array]:
    """The same from errors of prediction of every order."""
    left = [max(float(np.square(values).mean()), 1e-300)]
    reflection = []
    pairs = [(values[a:b], values[a:b]) for a, b in series.edges]
    for _ in range(orders):
        pairs = [(f[1:], g[:-1]) for f, g in pairs if len(f) > 1]
        size = sum(float(f @ f + g @ g) for f, g in pairs)
        k = -2.0 * sum(float(f @ g) for f, g in pairs) / size if size > 0 else 0.0
        reflection.append(k)
        left.append(max(left[-1] * (1.0 - k * k), 1e-300))
        pairs = [(f + k * g, g + k * f) for f, g in pairs]
    return np.array(reflection), np.array(left)


def _polynomial(reflection: Sequence[float] | Array) -> Array:
    """Coefficients 1, a_1, ..., a_p of an autoregression (p + 1,)."""
    a: Array = np.zeros(len(reflection) + 1)
    a[0] = 1.0
    for m, k in enumerate(reflection, 1):
        a[: m + 1] += k * a[m::-1]
    return a


def _filtered(reflection: Sequence[float] | Array, values: Array, series: Series) -> Array:
    """Columns (N, k) through the whitening filter; rows near a start are scaled to the same variance."""
    p = len(reflection)
    if not p:
        return values
    a, out, starts = _polynomial(reflection), np.empty_like(values), []
    for first, end in series.edges:
        for column in range(values.shape[1]):  # what lfilter does, which takes as long to get there
            out[first:end, column] = np.convolve(a, values[first:end, column])[: end - first]
        starts.append(np.arange(first, min(first + p, end)))
    ends = np.cumsum([len(rows) for rows in starts]).tolist()
    short = Series(tuple(zip([0, *ends[:-1]], ends, strict=True)))
    near = np.concatenate(starts)
    out[near] = _lattice(reflection, values[near], short)
    return out


def _lattice(reflection: Sequence[float] | Array, values: Array, series: Series) -> Array:
    """The same order by order, as rows near a start need it."""
    place = series.place
    forward, backward = values, values
    for m, k in enumerate(reflection, 1):
        live = (place >= m)[:, None]
        delayed = np.concatenate((np.zeros_like(backward[:1]), backward[:-1]))
        forward, backward = np.where(live, forward + k * delayed, forward), delayed + k * forward
    kept = np.cumprod(np.concatenate(([1.0], 1.0 - np.square(reflection))))
    scale = np.sqrt(kept[-1] / kept[np.minimum(place, len(reflection))])
    return np.asarray(forward * scale[:, None])
