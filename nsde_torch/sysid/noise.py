"""The noise of one channel of residuals, the filter that makes it white, and what other channels say of it.

    (1 + a_1 B + ... + a_p B^p) r_k = (1 - c B) e_k,      B r_k = r_{k-1},      e white

an autoregression for what lasts, a moving average for the difference of two errors of the sensor; second differences of
a position, which replace a rate that no sensor measured, have (1 - c B)^2. Whitening is causal, which keeps feedback
from biasing the estimate (Ljung, System Identification, 1999, section 13.4).

- c, p: least Akaike score of the exact likelihood of the moving average with the error e before the first row for
  an unknown of its own; c is at most `limit`, which follows from noise that is known to be there.
- a: Burg's method over all stretches, as reflection coefficients; rows near a start use the lower orders. Then a_j is
  multiplied by exp(-j / m): noise forgets within m rows. What lasts longer, as thrust that falls from take-off to
  landing, must not pass for noise.

**Feedback.** An input that was made from an attitude knows of the gyro's error before the gyro's channel does, and the
estimate is biased (a motor's lag by 3 %). So what the past of kinematic residuals predicts is taken out (`past`):

    s = measured minus integrated change of the states that no parameter moves,   S_j = sum_i c_j^i s_{k-1-i}
    e_k <- e_k - S_k b,    b by least squares (multivariate prediction errors: Ljung, 1999, section 7.2)

With `channels` the past of the residuals of the channels themselves is taken out too, as a gentle flight in gusts has
little in its inputs but answers to what struck it: what is left is new to inputs that were made from the log, and the
estimate is right whatever the laws are (an instrumental variable; Soderstrom and Stoica, 1983), with wider intervals.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, log

import numpy as np
from scipy.signal import lfilter

from nsde_torch.arrays import Array, Labels
from nsde_torch.jit import compiled


@dataclass(frozen=True)
class Series:
    """Stretches of rows."""

    edges: tuple[tuple[int, int], ...]  # ranges (first, last + 1), adjacent and in order

    def __len__(self) -> int:
        return self.edges[-1][1]

    @property
    def place(self) -> Labels:
        """Row number inside its stretch (N,)."""
        return np.concatenate([np.arange(b - a) for a, b in self.edges])

    def lagged(self, values: Array, lags: Sequence[int]) -> Array:
        """Columns (N, n) of so many rows before, side by side (N, n len(lags)); zero where a stretch had not begun."""
        place, parts = self.place[:, None], [values[:, :0]]
        for lag in lags:
            moved = np.zeros_like(values)
            moved[lag:] = values[: len(values) - lag] if lag else values
            parts.append(np.where(place >= lag, moved, 0.0))
        return np.concatenate(parts, 1)

    def shifted(self, values: Array, by: int) -> Array:
        """Values (N, ...) of so many rows later, of the first or last row where a stretch has none."""
        rows = [np.clip(np.arange(a, b) + by, a, b - 1) for a, b in self.edges]
        return np.asarray(values[np.concatenate(rows)])

    def boxes(self, width: int) -> "Series":
        """Series of the sums that `summed` makes."""
        ends = np.cumsum([(b - a) // width for a, b in self.edges]).tolist()
        return Series(tuple(zip([0, *ends[:-1]], ends, strict=True)))

    def summed(self, values: Array, width: int) -> Array:
        """Sums over boxes of `width` rows (M, ...); rows beyond the last whole box of a stretch are dropped."""
        if width == 1:
            return values
        parts = []
        for a, b in self.edges:
            count = (b - a) // width
            cut = values[a : a + count * width]
            parts.append(cut.reshape(count, width, *values.shape[1:]).sum(1))
        return np.concatenate(parts)

    def blocks(self, rows: int) -> Labels:
        """Number of the block of each row (N,): every stretch in equal blocks of about `rows` rows."""
        labels, first = [], 0
        for a, b in self.edges:
            count = max(1, round((b - a) / rows))
            labels.append(first + np.minimum(np.arange(b - a) * count // (b - a), count - 1))
            first += count
        return np.concatenate(labels)


_GRID = 1.0 - np.array([1, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12, 0.08, 0.05, 0.03, 0.02, 0.012, 0.008, 0.005])
_AKAIKE = 2.0
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

    def likelihood(self, rows: int) -> float:
        """Log likelihood of rows that it was fitted to, less one for each of its parameters (Akaike)."""
        return -rows * log(self.std) - self.parameters

    def whiten(self, values: Array, series: Series) -> Array:
        """Filtered columns (N, k) in units of `std`, one row more per stretch than there were: (N + stretches, k)."""
        summed = _carry(self.carry, values, series, self.times)
        return _filtered(self.reflection, summed, extended(series)) / self.std

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


def first_guess(residual: Array, series: Series, limit: float, *, times: int = 1) -> Noise:
    """Noise of a sensor alone: what to start with, as it weighs slow motion most; white where the limit is 0."""
    carry = min(limit, 0.98)
    summed = _carry(carry, residual[:, None], series, times)[:, 0]
    return Noise(carry, np.zeros(0), _size(summed, len(series)), times)


def estimate(
    residual: Array, series: Series, *, limit: float, orders: int, memory: float = inf, times: int = 1
) -> Noise:
    """Law of the noise of residuals (N,).

    Args:
        limit: Largest c.
        orders: Largest order of the autoregression.
        memory: Rows after which noise forgets (m).
        times: How many times 1 - c B is there.
    """
    grid = np.append(_GRID[limit > _GRID], limit)
    scores = {c: _score(residual, series, c, orders, times) for c in grid.tolist()}
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
    # nothing new is left: nan, which a regression refuses
    with np.errstate(divide="ignore", invalid="ignore"):
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
    parts = []
    for a, b in series.edges:
        total = lfilter([1.0], [1.0, -c], values[a:b], axis=0)
        fading = np.cumprod(np.append(1.0, np.full(b - a, c)))
        before = -(fading[1:] @ total) / np.square(fading).sum()
        parts.append(np.concatenate((np.zeros((1, values.shape[1])), total)) + fading[:, None] * before)
    return np.concatenate(parts)


def _burg(values: Array, series: Series, orders: int) -> tuple[Array, Array]:
    """Reflection coefficients (orders,) and the variance left after each order (orders + 1,)."""
    reflection, left = np.empty(orders), np.empty(orders + 1)
    _predict(values.copy(), values.copy(), np.array(series.edges), reflection, left)
    return reflection, left


@compiled
def _predict(forward: Array, backward: Array, edges: Labels, reflection: Array, left: Array) -> None:
    """`_burg`, from errors of prediction (N,) forwards and backwards, which are lost."""
    left[0] = max(np.square(forward).mean(), 1e-300)
    for m in range(len(reflection)):
        size, both = 0.0, 0.0
        for i in range(len(edges)):
            for k in range(edges[i, 0] + m + 1, edges[i, 1]):
                size += forward[k] * forward[k] + backward[k - 1] * backward[k - 1]
                both += forward[k] * backward[k - 1]
        share = -2.0 * both / size if size > 0.0 else 0.0
        reflection[m] = share
        left[m + 1] = max(left[m] * (1.0 - share * share), 1e-300)
        for i in range(len(edges)):
            for k in range(edges[i, 1] - 1, edges[i, 0] + m, -1):
                one, other = forward[k], backward[k - 1]
                forward[k] = one + share * other
                backward[k] = other + share * one


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
    lower = np.zeros((p + 1, p + 1))
    for m in range(p + 1):
        lower[m, : m + 1] = _polynomial(reflection[:m])
    kept = np.cumprod(np.concatenate(([1.0], 1.0 - np.square(reflection))))
    lower *= np.sqrt(kept[-1] / kept)[:, None]
    out = np.empty_like(values)
    for a, b in series.edges:
        out[a:b] = lfilter(lower[p], [1.0], values[a:b], axis=0)
        for k in range(min(p, b - a)):
            out[a + k] = lower[k, k::-1] @ values[a : a + k + 1]
    return out


# ---- what other channels say ---------------------------------------------------------------------------

_FADING = (0.0, 0.5, 0.8, 0.9, 0.95)
_FEWEST_ROWS = 200  # per column: what is taken out is lost to the parameters, and short data cannot afford it
_FADING_OF_ALL = (0.0, 0.8, 0.95)
_FEWEST_ROWS_OF_ALL = 5  # per column: without it, short data in a closed loop are wrong and not only vague


def past(residuals: Array, series: Series, *, channels: bool = False) -> Array:
    """Orthonormal columns (N + stretches, p) that span what is known before each whitened row; none for short data.

    Residuals (N, m) are kinematic ones, with `channels` those of all channels.
    """
    out = faded(residuals, series, channels=channels)
    if len(out) < (_FEWEST_ROWS_OF_ALL if channels else _FEWEST_ROWS) * out.shape[1]:
        return out[:, :0]
    length = np.linalg.norm(out, axis=0)
    if not length.any():
        return out[:, :0]
    basis, values, _ = np.linalg.svd(out[:, length > 0] / length[length > 0], full_matrices=False)
    return np.asarray(basis[:, values > 1e-6 * values[0]])


def faded(residuals: Array, series: Series, *, channels: bool = False) -> Array:
    """What is known before each whitened row: fading sums S of earlier residuals (N + stretches, p), see `past`.

    Columns are those of the residuals with the first c, then with the second, and so on.
    """
    fading = _FADING_OF_ALL if channels else _FADING
    out = np.zeros((len(residuals) + len(series.edges), residuals.shape[1] * len(fading)))
    for (a, b), (first, last) in zip(series.edges, extended(series).edges, strict=True):
        parts = [lfilter([1.0], [1.0, -c], residuals[a:b], axis=0) for c in fading]
        out[first + 2 : last] = np.concatenate(parts, 1)[:-1]
    return out
