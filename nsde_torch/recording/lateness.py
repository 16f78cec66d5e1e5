"""Channels that are logged later than others: positions against velocities, an attitude against body rates.

A position that is logged a time d later than its velocity, p_log(t) = p(t - d), changes over T by

    p_log(t + T) - p_log(t) = s * integral of v dt - d (v(t + T) - v(t)) + b T

to first order in d, with a clock s and a bias b of the velocity beside it. T is where the change of the velocity has
grown as large as the velocity itself. Noise of the velocity would pull d towards nothing; the central difference of the
position, whose noise is neither in v(t) nor in p(t), is its instrument (instrumental variables; Durbin, 1954).
Standard errors are from leaving out a twentieth of the intervals at a time (jackknife); axes of one sensor are joined
as in `kinematics.pool`. Which of two channels is the late one kinematics cannot say outright, but sensors and filters
delay: a positive d is the position's, a negative one the velocity's.

A filter of first order, d x_log' + x_log = x, is late by d too, at low frequencies. Which of the two it is shows in
what each leaves of the equation above once it is undone, x(t) = x_log(t + d) or x = x_log + d x_log'. The second makes
noise larger; therefore both channels are averaged first, which leaves them as late as they are.

Times are seconds of the log's own clock.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import isfinite, log

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.special import stdtr, stdtrit

from nsde_torch.data.kinematics import ATTITUDE, Slope, axis_groups, pool, rates_of
from nsde_torch.data.run import Run
from nsde_torch.data.system_info import SystemInfo, derivative_columns, rate_columns
from nsde_torch.recording.channels import common_name, moved, unfiltered

Array = NDArray[np.float64]

_FOLDS = 20
_FEWEST = 40
"""Intervals, each beginning in the middle of the one before, from which a time is estimated."""
_LONGEST_S = 0.5
_SURE_STEPS = 0.6
_MOST_ROWS = 60_000
"""Rows that are looked at; of longer recordings the first part of each segment."""
_OWN = 0.5  # largest share of a channel's changes that its rate does not explain
_LEVEL = 0.9
_ITERATIONS = 3
_AVERAGED = 4  # times a delay, over which channels are averaged to tell it from a filter
_NATS = 4.0  # by which a filter must be better than a delay


@dataclass(frozen=True)
class Late:
    """A channel that is logged late against another.

    Args:
        channel: The late one: a state, or the common name of several (`p` of `p_x p_y p_z`).
        other: What it is late against.
        seconds: By how much, in seconds of the log.
        low, high: 90 % interval.
        p: Chance of so much in a log where both are on time.
        filtered: Whether a filter of first order does better than a delay; then `seconds` is its time constant.
    """

    channel: str
    other: str
    seconds: float
    low: float
    high: float
    p: float
    filtered: bool = False

    @property
    def early(self) -> Late:
        """The same the other way round."""
        return replace(self, seconds=-self.seconds)


def lateness(system: SystemInfo, runs: Sequence[Run], *, clock: float = 1.0) -> list[Late]:
    """How late positions are logged against their rates, or the other way round, for each sensor that can show it.

    Args:
        system: Names of the states.
        runs: The runs.
        clock: Physical seconds per logged second.
    """
    out = []
    for group, late, filtered in _measured(system, runs, clock):
        value, error = late.value / clock, late.error / clock
        half = float(stdtrit(late.degrees, 0.5 * (1 + _LEVEL))) * error
        p = 2.0 * float(stdtr(late.degrees, -abs(value) / error))
        channel, other = _labels(system, group)[:: 1 if value > 0 else -1]
        out.append(Late(channel, other, abs(value), abs(value) - half, abs(value) + half, p, filtered))
    return out


@dataclass(frozen=True)
class Lag:
    """How late one channel is against another, with its sign.

    Args:
        channel: A position or an attitude.
        other: Its rate.
        seconds: By how much the first is late [s of the log]; negative where it is early.
        error: Standard error [s of the log].
        degrees: Degrees of freedom of the error.
    """

    channel: str
    other: str
    seconds: float
    error: float
    degrees: int


def lags(system: SystemInfo, runs: Sequence[Run], *, clock: float = 1.0) -> list[Lag]:
    """How late positions are against their rates, of each sensor that can show it, with signs; see `lateness`."""
    return [
        Lag(*_labels(system, group), fit.value / clock, fit.error / clock, fit.degrees)
        for group, fit, _ in _measured(system, runs, clock)
    ]


def _measured(system: SystemInfo, runs: Sequence[Run], clock: float) -> Iterator[tuple[str, _Fit, bool]]:
    """Group, how late its positions are, and whether a filter did it."""
    dt = runs[0].dt * clock
    parts: dict[str, list[tuple[Array, Array, Array]]] = {}
    share = min(1.0, _MOST_ROWS / sum(len(run) for run in runs))
    for run in runs:
        for a, b in ((a, a + int(share * (b - a))) for a, b in run.segments):
            if b - a < 4:
                continue
            for group, _, change, integral in axis_groups(system, run.x[a:b], dt):
                rate = rates_of(system, group, run.x[a:b])
                parts.setdefault(group, []).append((change, integral, rate))
    for group, pieces in parts.items():
        rough = _late(group, pieces, dt, filtered=False)
        if rough is not None:
            yield group, *_finer(group, pieces, dt, rough)


@dataclass(frozen=True)
class _Fit:
    """How late positions are [s], its standard error and degrees of freedom; and what is left over [nats]."""

    value: float
    error: float
    degrees: int
    left: float


def surely_late(late: Sequence[Late], dt: float, *, chance: float) -> list[Late]:
    """Those that are late by more than half a step `dt` [s of the log]: less may be how a simulator steps."""
    return [d for d in late if d.p * len(late) < chance and d.low > _SURE_STEPS * dt]


def by_kind(late: Sequence[Late]) -> dict[str, list[Late]]:
    """Delays and filters, by the name of the fault and of the option that takes it out; only kinds that there are."""
    kinds = {
        "sensor_delay": [d for d in late if not d.filtered],
        "sensor_lag": [d for d in late if d.filtered],
    }
    return {name: some for name, some in kinds.items() if some}


def _finer(
    group: str, pieces: Sequence[tuple[Array, Array, Array]], dt: float, delay: _Fit
) -> tuple[_Fit, bool]:
    """A delay that was roughly found, from averaged channels; or the filter that stands for it, and True."""
    steps = round(_AVERAGED * abs(delay.value) / dt)
    if abs(delay.value) <= dt or any(len(rate) < 8 * steps for _, _, rate in pieces):
        return delay, False  # below a step, they are alike
    smooth = [_averaged(piece, steps) for piece in pieces]
    one, other = (_late(group, smooth, dt, filtered=f) for f in (False, True))
    if one is None:
        return delay, False
    return (other, True) if other is not None and other.left < one.left - _NATS else (one, False)


def _averaged(piece: tuple[Array, Array, Array], steps: int) -> tuple[Array, Array, Array]:
    """Means of means over so many steps, without the ends."""

    def mean(a: Array) -> Array:
        return np.asarray(uniform_filter1d(uniform_filter1d(a, steps, axis=0), steps, axis=0)[steps:-steps])

    change, integral, rate = piece
    return mean(change), mean(integral), mean(rate)


def _late(
    group: str, pieces: Sequence[tuple[Array, Array, Array]], dt: float, *, filtered: bool
) -> _Fit | None:
    """The delay or the filter: what is found to first order is undone, until nothing is found."""
    total = 0.0
    error, degrees, left = float("inf"), 1, 0.0
    for _ in range(_ITERATIONS):
        data = _intervals([_undone(p, total / dt, dt, filtered=filtered) for p in pieces], dt)
        times = [] if data is None else _times(group, data, dt)
        if data is None or not times:
            return None
        pooled = pool(times)
        total += pooled.value
        if abs(total) > _LONGEST_S:
            return None  # another quantity
        error, degrees = pooled.error, max(pooled.slopes - 1, _FOLDS - 1)
        left = sum(log(_rest(data[:, :, int(t.axis)])) for t in times)
        left *= 0.25 * data.shape[1]  # intervals overlap by half
    return _Fit(total, error, degrees, left)


def _rest(one: Array) -> float:
    """Square of what is left of a channel's changes."""
    gap, change, _, integral = one
    by = np.stack([change, integral, np.ones_like(gap)], 1)
    size = np.sqrt(np.square(by).mean(0)) + 1e-300
    left = gap - (by / size) @ np.linalg.lstsq(by / size, gap, rcond=1e-10)[0]
    return float(left @ left) + 1e-300


def _undone(
    piece: tuple[Array, Array, Array], rows: float, dt: float, *, filtered: bool
) -> tuple[Array, Array, Array]:
    """Changes, integrals and rates with one of the two as it was: the changes, or the rates if `rows` is negative."""
    change, integral, rate = piece
    lost = 0 if filtered else int(np.ceil(abs(rows)))
    if rows == 0 or len(rate) < lost + 4:
        return piece
    if rows > 0:
        whole = np.concatenate([np.zeros((1, change.shape[1])), np.cumsum(change, 0)])
        change = np.diff(unfiltered(whole, rows) if filtered else moved(whole, rows), axis=0)
    else:
        rate = unfiltered(rate, -rows) if filtered else moved(rate, -rows)
        integral = 0.5 * dt * (rate[1:] + rate[:-1])
    keep = len(rate) - lost
    return change[: keep - 1], integral[: keep - 1], rate[:keep]


def _intervals(pieces: Sequence[tuple[Array, Array, Array]], dt: float) -> Array | None:
    """Gap, change of the rate (negative), its instrument and integral (4, intervals, axes); None of too few."""
    n = _span([rate for _, _, rate in pieces], dt)
    rows = []
    for change, integral, rate in pieces:
        starts = np.arange(1, len(rate) - n - 1, max(1, n // 2))
        if not len(starts):
            continue
        over = np.concatenate([np.zeros((1, rate.shape[1])), np.cumsum(change - integral, 0)])
        foretold = np.concatenate([np.zeros((1, rate.shape[1])), np.cumsum(integral, 0)])
        slope = (change[1:] + change[:-1]) / (2.0 * dt)  # at rows 1, 2, ...
        ends = starts + n
        rows.append(
            np.stack(
                [
                    over[ends] - over[starts],
                    rate[starts] - rate[ends],
                    slope[starts - 1] - slope[ends - 1],
                    foretold[ends] - foretold[starts],
                ]
            )
        )
    data = np.concatenate(rows, axis=1) if rows else None
    return data if data is not None and data.shape[1] >= _FEWEST else None


def _times(group: str, data: Array, dt: float) -> list[Slope]:
    """How late the position is by axis [s], of the axes that move."""
    count = data.shape[1]
    out = []
    for axis in range(data.shape[2]):
        one = data[:, :, axis]
        if np.square(one[0]).sum() > _OWN * np.square(one[0] + one[3]).sum():
            continue  # it does not move as its rate says
        value = _time(one)
        left_out = np.array(
            [_time(np.delete(one, f, axis=1)) for f in np.array_split(np.arange(count), _FOLDS)]
        )
        if not (isfinite(value) and np.isfinite(left_out).all()):
            continue
        error = float(np.sqrt((1 - 1 / _FOLDS) * np.square(left_out - left_out.mean()).sum()))
        out.append(Slope("", str(axis), group, value, max(error, 1e-9 * dt), count, 0.0))
    return out


def _time(one: Array) -> float:
    gap, change, instrument, integral = one
    ones = np.ones_like(gap)
    z, r = np.stack([instrument, integral, ones]), np.stack([change, integral, ones], 1)
    scale = np.sqrt(np.square(r).mean(0)) + 1e-300
    value: float = np.linalg.lstsq(z @ (r / scale), z @ gap, rcond=1e-10)[0][0] / scale[0]
    return float(value)


def _span(rates: Sequence[Array], dt: float) -> int:
    """Steps over which rates change as much as they vary."""

    def rms(parts: Sequence[Array]) -> float:
        return float(np.sqrt(np.square(np.concatenate(parts)).mean())) if parts else 0.0

    size = rms([w - w.mean(0) for w in rates])
    n = 1
    while n * dt < _LONGEST_S and rms([w[n:] - w[:-n] for w in rates if len(w) > n]) < size:
        n = max(n + 1, int(1.3 * n))
    return n


def sensors(system: SystemInfo) -> list[tuple[str, str]]:
    """Channels that one sensor brings: a position and its rate, an attitude and body rates, by their common names."""
    attitude = system.quaternion is not None and rate_columns(system) is not None
    return [
        _labels(system, group) for group in (*derivative_columns(system), *([ATTITUDE] if attitude else []))
    ]


def _labels(system: SystemInfo, group: str) -> tuple[str, str]:
    """Common names of the positions of a group, and of their rates."""
    names = system.state_names
    if group in derivative_columns(system):
        i, j = derivative_columns(system)[group]
        return common_name([names[k] for k in i]), common_name([names[k] for k in j])
    rates = rate_columns(system)
    assert rates is not None
    assert system.quaternion is not None
    return common_name(names[system.quaternion]), common_name(names[rates])
