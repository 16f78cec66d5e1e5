"""Checks that need no physics: a position is the integral of its velocity, an attitude that of its body rate.

    p(t + T) - p(t) = s * integral of v dt          R(t)^T R(t + dt) = exp(s * omega dt)

with `s` physical seconds for each logged second: 1 where the clock is right. Two faults show here and nowhere
else.

*Hidden gaps*: rows lost without a trace in the clock. The one-step residual `p[k+1] - p[k] - dt (v[k] +
v[k+1]) / 2` is then large once, while its neighbours are small. A row is a jump if its residual (norm over
one group of axes) exceeds 10 robust standard deviations of all residuals, 4 times the 90 % quantile of its
neighbourhood, and a whole step of travel at the run's 95 % speed. The middle condition keeps a manoeuvre, or
a log whose steps alternate, from being cut. Two residuals in a row that cancel are a sample that is off, not time
that is lost.

*A clock that is not what it says*: increments of position over disjoint intervals are regressed on the
integral of velocity (with an intercept, so that a velocity bias does not count). Noise in the velocity would
pull the slope towards zero; the integral over the even samples serves as an instrument for that over the odd
samples and the other way round, whose noises are independent (instrumental variables; Wald 1940, Durbin
1954). The one is the trapezoidal rule and the other that of midpoints, of steps twice as long, whose errors are as 2
to -1 (Simpson's rule is without them): weighted 2 to 1 they cancel from the slope to first order. Standard errors
come from leaving out a tenth of the intervals at a time (jackknife). Slopes of axes and runs are joined as in a
random-effects meta-analysis (DerSimonian and Laird, 1986), because they differ by more than their own errors.

Assumed and not checked: velocities are means of nothing (point samples), and white noise.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import percentile_filter
from scipy.signal import lfilter
from scipy.special import stdtr, stdtrit

from nsde_torch.arrays import Array
from nsde_torch.data.quaternion import increments
from nsde_torch.data.system_info import RATE_NAMES, SystemInfo, derivative_columns, rate_columns

JUMP_SIGMAS = 10.0
JUMP_ISOLATION = 4.0
NEIGHBOURHOOD = 25  # samples on each side of a jump against which it is judged
_BACK = 0.5  # of a jump that the next one leaves
INTERVAL_S = 0.5
"""Length of the intervals of the clock regression [s]: long against noise, short against drift of a bias."""
MIN_INTERVALS = 20  # fewest intervals from which a slope is estimated
FOLDS = 10  # parts of the jackknife
LEVEL = 0.9  # level of intervals


@dataclass(frozen=True)
class Slope:
    """Regression of measured increments on integrated rates for one axis of one run."""

    run: str  # name of the run
    axis: str  # name of the position, or of the body rate
    group: str  # group of axes (`position (world, m)`, `attitude`)
    value: float  # physical seconds for each logged second
    error: float  # standard error of the value
    intervals: int  # number of intervals
    r2: float  # share of the variance of the increments that the integral explains at the fitted slope


@dataclass(frozen=True)
class Uncertain:
    """A value with its standard error, and the degrees of freedom of that (Student's t)."""

    value: float
    error: float
    degrees: int

    @property
    def p(self) -> float:
        """Chance of so much where there is nothing."""
        return 2.0 * float(stdtr(self.degrees, -abs(self.value) / self.error))

    @property
    def half(self) -> float:
        """Half of the 90 % interval."""
        return float(stdtrit(self.degrees, 0.5 * (1 + LEVEL))) * self.error

    @property
    def low(self) -> float:
        """Lower end of the 90 % interval."""
        return self.value - self.half

    @property
    def high(self) -> float:
        """Upper end of the 90 % interval."""
        return self.value + self.half


@dataclass(frozen=True)
class Pooled:
    """Slopes joined: mean, its standard error, and the spread between the slopes beyond their errors."""

    value: float
    error: float
    spread: float
    slopes: int


ATTITUDE = "attitude"  # name of the group of an attitude and its body rates


def axis_groups(system: SystemInfo, x: Array, dt: float) -> list[tuple[str, Array, Array, Array]]:
    """(group, increments (n-1, k), integrals of the rate (n-1, k), both over single steps, and the rate (n, k))."""
    out = []
    for group, pair in pairs_of(system).items():
        p, v = (x[:, [system.state_names.index(name) for name in names]] for names in pair)
        change = increments(p) if group == ATTITUDE else np.diff(p, axis=0)
        out.append((group, change, 0.5 * dt * (v[1:] + v[:-1]), v))
    return out


def find_jumps(system: SystemInfo, x: Array, *, dt: float) -> list[tuple[int, str, float, float]]:
    """Hidden gaps inside one segment (n, nx) of uniform step [s], in order; see the module's text for the test.

    Of each the row after which a group of axes jumps, the group, by how much beyond what its rate explains (its unit),
    and about how much time is missing [s].
    """
    if len(x) < 2 * NEIGHBOURHOOD:
        return []
    found: dict[int, tuple[int, str, float, float]] = {}
    for group, increment, integral, _ in axis_groups(system, x, dt):
        rest = increment - integral
        size = np.linalg.norm(rest, axis=1)
        speed = np.linalg.norm(integral, axis=1)
        sigma = 1.4826 * float(np.median(size))
        travel = float(np.quantile(speed, 0.95))
        candidates = np.flatnonzero(size > max(JUMP_SIGMAS * sigma, travel, 1e-12))
        # many are a rate of another quantity; the clock check speaks about that
        if not 0 < len(candidates) <= 0.01 * len(size):
            continue
        usual = percentile_filter(size, 90, size=2 * NEIGHBOURHOOD + 1, mode="nearest")
        back = np.linalg.norm(rest[1:] + rest[:-1], axis=1) < _BACK * size[1:]
        returns = np.concatenate([back, [False]]) | np.concatenate([[False], back])
        for row in candidates[(size[candidates] > JUMP_ISOLATION * usual[candidates]) & ~returns[candidates]]:
            near = slice(max(0, row - 3), row + 4)
            missing = dt * float(size[row]) / max(float(np.median(speed[near])), 1e-12)
            found.setdefault(int(row), (int(row), group, float(size[row]), missing))
    return [found[k] for k in sorted(found)]


def _slope(b: Array, even: Array, odd: Array) -> float:
    """Slope of increments on integrals; with even = I + 2 e and odd = I - e, to first order in e it is that on I."""
    b, even, odd = (a - a.mean() for a in (b, even, odd))
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(((2.0 * even + odd) @ b) / (3.0 * (even @ odd)))


def _quadrature(b: Array, even: Array, odd: Array) -> float:
    """Share by which a slope may be off because rows are too far apart for the motion: 2 (e / I)^2, see `_slope`.

    The noise of the rate is not in the increments, which e is therefore compared with.
    """
    b, even, odd = (a - a.mean() for a in (b, even, odd))
    whole = (even + 2.0 * odd) @ b
    return 2.0 * float((even - odd) @ b / whole) ** 2 if whole else 0.0


def clock_slopes(system: SystemInfo, name: str, segments: Sequence[Array], *, dt: float) -> list[Slope]:
    """Slopes of all axes of one run; axes that do not move, or fewer than 20 intervals, give none.

    Segments are states (n_i, nx), `dt` is the logged step [s].
    """
    length = max(4, 2 * round(0.5 * INTERVAL_S / dt))
    parts: dict[str, list[Array]] = {}
    for x in segments:
        if len(x) <= length:
            continue
        edges = np.arange(0, len(x), length)
        for group, increment, _, rate in axis_groups(system, x, dt):
            total = _sums(np.append(increment, increment[-1:], axis=0), edges)
            # trapezoid over the even samples (ends halved), midpoint rule over the odd samples: both span it
            even, odd = rate.copy(), rate.copy()
            even[1::2] = odd[0::2] = 0.0
            half = 0.5 * (rate[edges[1:]] - rate[edges[:-1]])
            a_even = 2.0 * dt * (_sums(even, edges) + half)
            a_odd = 2.0 * dt * _sums(odd, edges)
            parts.setdefault(group, []).append(np.stack([total, a_even, a_odd]))
    out, pairs = [], pairs_of(system)
    for group, pieces in parts.items():
        data = np.concatenate(pieces, axis=1)
        n = data.shape[1]
        if n < MIN_INTERVALS:
            continue
        for k, axis in enumerate(pairs[group][group == ATTITUDE]):
            b, even, odd = data[:, :, k]
            estimate = jackknife(lambda one: _slope(*one), data[:, :, k], FOLDS)
            if estimate is None:
                continue
            value, error = estimate
            error = float(np.hypot(error, value * _quadrature(b, even, odd)))
            a = 0.5 * (even + odd)
            rest = (b - b.mean()) - value * (a - a.mean())
            r2 = 1.0 - float(rest @ rest) / max(float(((b - b.mean()) ** 2).sum()), 1e-300)
            out.append(Slope(name, axis, group, value, error, n, r2))
    return out


def jackknife(estimate: Callable[[Array], float], data: Array, folds: int) -> tuple[float, float] | None:
    """An estimate from data (k, n), and its standard error from leaving out one of so many parts of n at a time.

    None where one of the two is not finite.
    """
    value, parts = estimate(data), np.array_split(np.arange(data.shape[1]), folds)
    left_out = np.array([estimate(np.delete(data, part, axis=1)) for part in parts])
    if not (np.isfinite(value) and np.isfinite(left_out).all()):
        return None
    return value, float(np.sqrt((1 - 1 / folds) * np.square(left_out - left_out.mean()).sum()))


def _sums(a: Array, edges: NDArray[np.int64]) -> Array:
    total: Array = np.add.reduceat(a, edges, axis=0)[:-1]
    return total


def pairs_of(system: SystemInfo) -> dict[str, tuple[list[str], list[str]]]:
    """Names of positions and of their rates, of an attitude and body rates, by group as in `axis_groups`."""
    names = list(system.state_names)
    groups = derivative_columns(system).items()
    out = {g: ([names[k] for k in i], [names[k] for k in j]) for g, (i, j) in groups}
    if system.quaternion is not None and rate_columns(system) is not None:
        out[ATTITUDE] = (names[system.quaternion], list(RATE_NAMES))
    return out


def called(group: str, axes: Sequence[str]) -> str:
    """A group of axes for people: one or two by their names, three as what they are together."""
    return group if len(axes) > 2 else ", ".join(axes)


def pool(slopes: Sequence[Slope]) -> Pooled:
    """Random-effects mean of slopes (DerSimonian and Laird); of none: 1 with an infinite error."""
    if not slopes:
        return Pooled(1.0, float("inf"), 0.0, 0)
    y = np.array([s.value for s in slopes])
    variance = np.array([max(s.error, 1e-6) for s in slopes]) ** 2
    w = 1.0 / variance
    fixed = (w @ y) / w.sum()
    q = float(w @ (y - fixed) ** 2)
    between = 0.0
    if len(y) > 1:
        between = max(0.0, (q - (len(y) - 1)) / (w.sum() - (w @ w) / w.sum()))
    w = 1.0 / (variance + between)
    return Pooled(float((w @ y) / w.sum()), float(w.sum() ** -0.5), float(np.sqrt(between)), len(y))


# Rates of positions by alpha-beta filters: the steady Kalman filter of a mass that white accelerations push.
#
#     e_k = q_k - (p + h v),   p <- p + h v + alpha e_k,   v <- v + beta e_k / h
#
# With the tracking index L = h^2 (size of the accelerations) / (noise of the position) (Kalata, The tracking
# index, IEEE Transactions on Aerospace and Electronic Systems 20 (1984)):
#
#     r = (4 + L - (8 L + L^2)^1/2) / 4,   alpha = 1 - r^2,   beta = 2 (2 - alpha) - 4 (1 - alpha)^1/2
#     noise of q = (1 - alpha) S,   what is not known of v = beta (2 alpha - beta) / (2 (1 - alpha)) noise / h^2,
#
# S the mean square of e. The index is that of the smallest S.

_SLOWEST_S = 0.15  # longest time constant of a filter: what it forgets in
_LARGEST = 30.0  # tracking index: the position as it is
_FIRST = 30  # rows at the start of a stretch that do not judge a filter


_FILTERS = 17  # from the slowest one to one that takes positions as they are


def rates(stretches: Sequence[Array], dt: float) -> tuple[list[Array], float]:
    """Rates of positions (n,) without any physics, of the rows before and after alike, and what is not known of them.

    The stretches have no gap, and one step [s].
    """
    tried = []
    for index in np.geomspace(min((dt / _SLOWEST_S) ** 2, 0.1), _LARGEST, _FILTERS).tolist():
        r = (4.0 + index - sqrt(8.0 * index + index * index)) / 4.0
        alpha = 1.0 - r * r
        gains = alpha, 2.0 * (2.0 - alpha) - 4.0 * sqrt(1.0 - alpha)
        errors = [_filtered(q, dt, *gains)[0][_FIRST:] for q in stretches if len(q) > 2 * _FIRST]
        tried.append((float(np.square(np.concatenate(errors)).mean()) if errors else 0.0, gains))
    square, (alpha, beta) = min(tried, key=lambda one: one[0])
    both = [(_filtered(q, dt, alpha, beta)[1], _filtered(q[::-1], dt, alpha, beta)[1]) for q in stretches]
    kept = max(1.0 - alpha, 1e-9)
    share = max(beta * (2.0 * alpha - beta) / (2.0 * kept), 0.0)
    unknown = sqrt(share * kept * square) / dt
    return [0.5 * (before - after[::-1]) for before, after in both], unknown * sqrt(0.5)


def _filtered(q: Array, dt: float, alpha: float, beta: float) -> tuple[Array, Array]:
    """Errors of prediction and rates (n,)."""
    first = min(len(q), 10)
    slope = float(np.polyfit(np.arange(first), q[:first], 1)[0]) if first > 1 else 0.0
    left = q - q[0] - slope * np.arange(len(q))  # it starts at rest where the stretch does
    poles = [1.0, alpha + beta - 2.0, 1.0 - alpha]
    e = lfilter([1.0, -2.0, 1.0], poles, left)
    v = lfilter([beta / dt, -beta / dt], poles, left)
    return np.asarray(e), np.asarray(v + slope / dt)
