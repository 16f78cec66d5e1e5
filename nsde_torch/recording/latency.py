"""Sensor latency: channels that are logged later than others, found by the kinematics, and moved back.

A position that is logged a time d later than its velocity, p_log(t) = p(t - d), changes over T by

    p_log(t + T) - p_log(t) = s * integral of v dt - d (v(t + T) - v(t)) + b T

to first order in d, with a clock s and a bias b of the velocity beside it. T is where the change of the velocity has
grown as large as the velocity itself. The central difference of the position, whose noise is neither in v(t) nor in
p(t), is the instrument for the noise of the velocity (Durbin, 1954). Standard errors are from leaving out a twentieth
of the intervals at a time (jackknife); axes of one sensor are joined as in `kinematics.pool`. Sensors and filters
delay: a positive d is the position's, a negative one the velocity's.

A filter of first order, d x_log' + x_log = x, is late by d too, at low frequencies. Which of the two it is shows in
what each leaves of the equation above once it is undone, x(t) = x_log(t + d) or x = x_log + d x_log'. The second makes
noise larger; therefore both channels are averaged first, which leaves them as late as they are.

A sensor whose position and rate are late alike, and a column that is no rate of another, show in the declared physics
alone (`nsde_torch.diagnosis.late_columns`).
Times are seconds of the log's own clock.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite, log, nan
from typing import TypeAlias

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d
from scipy.optimize import brentq
from scipy.signal import lfilter
from scipy.special import chdtrc, ndtri, stdtr

from nsde_torch.arrays import Array
from nsde_torch.data.kinematics import Slope, Uncertain, axis_groups, jackknife, pairs_of, pool
from nsde_torch.data.raw import Finding
from nsde_torch.data.run import DataSet, Run
from nsde_torch.data.system_info import SystemInfo, channel_columns, common_name
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.recording.fault import Detected, LoggedRuns

_Piece: TypeAlias = tuple[Array, Array, Array]
"""Changes of positions over steps, integrals of their rates (n - 1, axes), and the rates (n, axes) of a stretch."""

LATE = 1e-4  # chance of calling a sensor late that is on time, when data are read
_LONGEST_S, _ITERATIONS = 0.5, 3
_FOLDS, _FEWEST = 20, 40
"""Folds of the jackknife, and fewest intervals that a time is estimated from; each begins in the middle of the last."""
_MOST_ROWS = 60_000  # rows that are looked at; of longer recordings the first part of each segment
_UNEXPLAINED = 0.5  # largest share of a channel's changes that its rate does not explain
_AVERAGED, _FILTER_NATS = 4, 4.0
"""Times a delay, over which channels are averaged to separate it from a filter; and by how much that must be better."""
_SURE_STEPS, _LEAST_STEPS = 0.6, 0.2
"""Steps by which a channel is late for sure, whatever a simulator does, and by which it matters at all."""


@dataclass(frozen=True)
class Latency(Uncertain):
    """How late one channel is against another [s of the log]; negative where it is early."""

    channel: str  # a state, or the common name of several (`p` of `p_x p_y p_z`)
    other: str  # what it is late against
    filtered: bool  # whether a filter of first order does better than a delay; then it is its time constant
    either: bool = False  # whether such a filter does as well as the delay

    @property
    def seconds(self) -> float:
        """By how much [s of the log]."""
        return self.value

    @property
    def fault(self) -> str:
        """Name of the fault, and of the option that takes it out."""
        return "sensor_lag" if self.filtered else "sensor_delay"


# found


def latencies(system: SystemInfo, runs: Sequence[Run], *, clock: float = 1.0) -> list[Latency]:
    """How late positions are logged against their rates, of each sensor that can show it; early ones are negative."""
    dt, out = runs[0].dt * clock, []
    parts: dict[str, list[_Piece]] = {}
    share = min(1.0, _MOST_ROWS / sum(len(run) for run in runs))
    for run in runs:
        for a, b in ((a, a + int(share * (b - a))) for a, b in run.segments):
            if b - a < 4:
                continue
            for group, change, integral, rate in axis_groups(system, run.x[a:b], dt):
                parts.setdefault(group, []).append((change, integral, rate))
    for group, (positions, rates) in pairs_of(system).items():
        rough = _time_of(group, parts[group], dt, filtered=False) if group in parts else None
        if rough is not None:
            fit, better = _delay_or_filter(group, parts[group], dt, rough[0])
            value = fit.value / clock, fit.error / clock, fit.degrees
            kind = better > _FILTER_NATS, abs(better) <= _FILTER_NATS
            out.append(Latency(*value, common_name(positions), common_name(rates), *kind))
    return out


def late_channels(system: SystemInfo, runs: Sequence[Run], *, clock: float = 1.0) -> list[Latency]:
    """The same with the channel first that is logged later than the other; see `latencies`."""
    return [
        one if one.value > 0 else replace(one, channel=one.other, other=one.channel, value=abs(one.value))
        for one in latencies(system, runs, clock=clock)
    ]


def surely_late(late: Sequence[Latency], dt: float, *, chance: float = LATE) -> list[Latency]:
    """Those that are late by more than half a step `dt` [s of the log]: less may be how a simulator steps."""
    return [one for one in late if one.p * len(late) < chance and one.low > _SURE_STEPS * dt]


_Fit: TypeAlias = tuple[Uncertain, float]  # how late positions are [s], and what remains unexplained [nats]


def _delay_or_filter(
    group: str, pieces: Sequence[_Piece], dt: float, delay: Uncertain
) -> tuple[Uncertain, float]:
    """A delay that was roughly found, from averaged channels, or the filter that does the same where it does better.

    And by how many nats that does better; nan where it was not tried.
    """
    steps = round(_AVERAGED * abs(delay.value) / dt)
    if abs(delay.value) <= dt or any(len(rate) < 8 * steps for _, _, rate in pieces):
        return delay, 0.0  # below a step, they are alike

    def averaged(values: Array) -> Array:
        once = uniform_filter1d(values, steps, axis=0)
        return np.asarray(uniform_filter1d(once, steps, axis=0)[steps:-steps])

    smooth = [(averaged(change), averaged(integral), averaged(rate)) for change, integral, rate in pieces]
    one, other = (_time_of(group, smooth, dt, filtered=f) for f in (False, True))
    if one is None or other is None:
        return (delay if one is None else one[0]), nan
    better = one[1] - other[1]
    return (other[0] if better > _FILTER_NATS else one[0]), better


def _time_of(group: str, pieces: Sequence[_Piece], dt: float, *, filtered: bool) -> _Fit | None:
    """The delay or the filter: what is found to first order is undone, until nothing is found."""
    total = 0.0
    for _ in range(_ITERATIONS):
        data = _intervals([_undone(p, total / dt, dt, filtered=filtered) for p in pieces], dt)
        times = _times(group, data, dt)
        if not times:
            return None
        pooled = pool(times)
        total += pooled.value
        if abs(total) > _LONGEST_S:
            return None  # another quantity
    left = sum(log(_rest(data[:, :, int(t.axis)])) for t in times)
    left *= 0.25 * data.shape[1]  # intervals overlap by half
    return Uncertain(total, pooled.error, max(pooled.slopes - 1, _FOLDS - 1)), left


def _rest(one: Array) -> float:
    """Square of the residual of a channel's changes."""
    gap, change, _, integral = one
    by = np.stack([change, integral, np.ones_like(gap)], 1)
    size = np.sqrt(np.square(by).mean(0)) + 1e-300
    left = gap - (by / size) @ np.linalg.lstsq(by / size, gap, rcond=1e-10)[0]
    return float(left @ left) + 1e-300


def _undone(piece: _Piece, rows: float, dt: float, *, filtered: bool) -> _Piece:
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


def _intervals(pieces: Sequence[_Piece], dt: float) -> Array:
    """Gap, change of the rate (negative), its instrument and integral (4, intervals, axes)."""
    n = _span([rate for _, _, rate in pieces], dt)
    rows = [np.zeros((4, 0, pieces[0][2].shape[1]))]
    for change, integral, rate in pieces:
        starts = np.arange(1, len(rate) - n - 1, max(1, n // 2))
        zero = np.zeros((1, rate.shape[1]))
        over, expected = (np.concatenate([zero, np.cumsum(a, 0)]) for a in (change - integral, integral))
        slope = (change[1:] + change[:-1]) / (2.0 * dt)  # at rows 1, 2, ...
        ends = starts + n
        gap, backwards = over[ends] - over[starts], rate[starts] - rate[ends]
        instrument = slope[starts - 1] - slope[ends - 1]
        rows.append(np.stack([gap, backwards, instrument, expected[ends] - expected[starts]]))
    return np.concatenate(rows, axis=1)


def _times(group: str, data: Array, dt: float) -> list[Slope]:
    """How late the position is by axis [s], of the axes that move; of too few intervals none."""
    out = []
    for axis in range(data.shape[2] if data.shape[1] >= _FEWEST else 0):
        one = data[:, :, axis]
        if np.square(one[0]).sum() > _UNEXPLAINED * np.square(one[0] + one[3]).sum():
            continue  # it does not move as its rate says
        found = jackknife(_time, one, _FOLDS)
        if found is not None:
            out.append(Slope("", str(axis), group, found[0], max(found[1], 1e-9 * dt), data.shape[1], 0.0))
    return out


def _time(one: Array) -> float:
    gap, change, instrument, integral = one
    ones = np.ones_like(gap)
    z, r = np.stack([instrument, integral, ones]), np.stack([change, integral, ones], 1)
    scale = np.sqrt(np.square(r).mean(0)) + 1e-300
    return float(np.linalg.lstsq(z @ (r / scale), z @ gap, rcond=1e-10)[0][0] / scale[0])


def _span(rates: Sequence[Array], dt: float) -> int:
    """Steps over which rates change as much as they vary."""

    def rms(parts: Sequence[Array]) -> float:
        return float(np.sqrt(np.square(np.concatenate(parts)).mean())) if parts else 0.0

    size = rms([w - w.mean(0) for w in rates])
    n = 1
    while n * dt < _LONGEST_S and rms([w[n:] - w[:-n] for w in rates if len(w) > n]) < size:
        n = max(n + 1, int(1.3 * n))
    return n


# undone

# Rows from which noise that was white in the log is nearly white again once a spline undid a filter or a part of a
# step: undoing a filter of 2.5 rows leaves correlations of -0.24, -0.35, 0.21 and -0.09 at one to four of them. Taken
# for white, effects were named in 9 of 60 carts with a late or filtered pole that lack nothing (one: tests/diagnosis)
_APART = 4
_PART = 0.25  # rows; undoing less leaves correlations of at most 0.12


def on_time(
    run: Run, system: SystemInfo, late: Mapping[str, float], filters: Mapping[str, float] | None = None
) -> Run:
    """A run whose late channels are moved to where they belong, x(t) = x_log(t + d); the ends of its segments go.

    What a filter of first order made late is undone first, x = x_log + T x_log'. Both mix the noise of several rows
    (`Run.apart`), but for moves by whole ones. Delays (negative: early) and time constants are in seconds of the log,
    by state or by the common name of several; a delay may be that of an input, which moves by whole rows as it is held
    in between. A ConfigError refuses an unknown channel and a time that is no number, a DataError a run that is too
    short.
    """
    for channel, d in (*late.items(), *(filters or {}).items()):
        if isinstance(d, bool) or not isinstance(d, int | float) or not isfinite(d):
            raise ConfigError(f"the time of {channel!r} must be a finite time [s]; got {d!r}.")
    inputs = {
        system.input_names.index(n): round(d / run.dt) for n, d in late.items() if n in system.input_names
    }
    moves, filtered_by = (
        [
            (channel_columns(system, channel), d / run.dt)
            for channel, d in times.items()
            if channel not in system.input_names
        ]
        for times in (late, filters or {})
    )
    x, u, segments = run.x.copy(), run.u.copy() if inputs else run.u, []
    each = [*inputs.values(), *(rows for _, rows in moves)]
    first, last = (max((0, *(int(np.ceil(s * rows - 1e-9)) for rows in each))) for s in (-1, 1))
    for a, b in run.segments:
        if b - a - first - last < 2:
            continue
        for columns, rows in filtered_by:
            x[a:b, columns] = unfiltered(x[a:b, columns], rows)
        for columns, rows in moves:
            x[a:b, columns] = moved(x[a:b, columns], rows)
        for column, whole in inputs.items():
            u[a:b, column] = run.u[np.clip(np.arange(a, b) + whole, a, b - 1), column]
        if system.quaternion is not None:
            x[a:b, system.quaternion] /= np.linalg.norm(x[a:b, system.quaternion], axis=1, keepdims=True)
        segments.append((a + first, b - last))
    if not segments:
        said = ", ".join(f"{1e3 * by:.3g} ms of {name}" for name, by in late.items())
        raise DataError(
            f"run {run.name!r} has no stretch that is long enough to take delays out of it ({said}). "
            "Leave the run out, or record without gaps."
        )
    between_rows = [columns for columns, rows in moves if abs(rows - round(rows)) > _PART]
    mixed = [*between_rows, *(columns for columns, rows in filtered_by if abs(rows) > _PART)]
    apart = {system.state_names[j]: _APART for columns in mixed for j in columns}
    return replace(run, x=x, u=u, segments=tuple(segments), apart={**run.apart, **apart})


def moved(x: Array, rows: float) -> Array:
    """Rows as they are `rows` later (earlier, if negative), by a cubic spline; at the end the last one is repeated."""
    k = np.arange(len(x), dtype=np.float64)
    at = np.clip(k + rows, 0.0, len(x) - 1.0)
    return np.asarray(CubicSpline(k, x)(at))


def unfiltered(x: Array, rows: float) -> Array:
    """What a filter of first order with a time constant of `rows` was given, x + rows dx/drow by a cubic spline."""
    return x + rows * np.asarray(CubicSpline(np.arange(len(x), dtype=np.float64), x)(np.arange(len(x)), 1))


# simulated


def filtered(x: Array, rows: float) -> Array:
    """A filter of first order with a time constant of `rows`, at rest at the first row, straight between rows."""
    if rows <= 0:
        return x
    keep = float(np.exp(-1.0 / rows))
    new, old = 1.0 - rows * (1.0 - keep), rows * (1.0 - keep) - keep
    return np.asarray(lfilter([new, old], [1.0, -keep], x, axis=0, zi=x[:1] * (keep + old))[0])


def changed(
    x: Array, system: SystemInfo, values: Mapping[str, float], change: Callable[[Array, float], Array]
) -> Array:
    """States (n, nx) whose channels are each changed by a number, an attitude back on the sphere."""
    x = x.copy()
    for name, value in values.items():
        columns = channel_columns(system, name)
        x[:, columns] = change(x[:, columns], value)
    if system.quaternion is not None:
        x[:, system.quaternion] /= np.linalg.norm(x[:, system.quaternion], axis=1, keepdims=True)
    return x


# described


def latency_findings(late: Sequence[Latency], *, action: str = "reported") -> list[Finding]:
    """What the data summary says of late sensors, by the option that takes them out."""
    out = []
    for key, how in (("sensor_delay", "late"), ("sensor_lag", "late behind a filter")):
        some = [d for d in late if d.fault == key]
        if not some:
            continue
        message = ", ".join(f"{d.channel} is {1e3 * d.seconds:.3g} ms {how} against {d.other}" for d in some)
        remedy = ", ".join(f"{d.channel}: {d.seconds:.3g}" for d in some)
        out_by = f"; `data.{key}={{{remedy}}}` takes it out"
        message += ", by the kinematics" + (out_by if action == "reported" else " at the log's own rate")
        values = {f"{d.channel}_s": d.seconds for d in some}
        out.append(Finding("late_sensor", "", len(some), message, action, values))
    return out


def suspected_latency(log: LoggedRuns) -> list[Detected]:
    """Channels that are late by less than what is sure; physics has to say, as a simulator may step so."""
    (late, sure), level = log.late, log.level("lateness")
    least = _LEAST_STEPS * log.runs[0].dt
    some = [d for d in late if d.p * len(late) < level and d.low > least and d not in sure]
    return [detected([d], short=True) for d in some]


def detected(late: Sequence[Latency], *, short: bool = False) -> Detected:
    """Channels that are delayed, or filtered, as one finding."""
    how = "late behind a filter, against" if late[0].filtered else "later than"
    words = ", ".join(f"{d.channel} is logged {1e3 * d.seconds:.3g} ms {how} {d.other}" for d in late)
    values = {d.channel: (d.seconds, d.low, d.high, "s") for d in late}
    text = f"Channels do not belong to the same time: {words}, as the one is the integral of the other."
    if any(d.either for d in late):
        text += " A filter of first order with that time constant would do as well: these data are too slow to tell."
    return Detected(late[0].fault, values, min(d.p for d in late), text, short)


# Streams whose clocks are offset against each other by another time in each run.
#
# An offset is estimated for each run, with its standard error, and held against one that all runs share,
#
#     Q = sum_r ((d_r - d) / s_r)^2,        d = sum_r (d_r / s_r^2) / sum_r s_r^-2,
#
# which is chi-square with one degree of freedom less than there are runs. Where it is not by chance, the offset of each
# run is taken out, drawn towards the mean by how unsure it is (empirical Bayes):
#
#     d + t^2 / (t^2 + s_r^2) (d_r - d),     t^2 the variance between runs (Paule and Mandel 1982).
#
# One that all runs share is left to what looks for late sensors. Those of inputs are not looked for: in a closed loop,
# what answers what hides time (docs/content/theory/recording.md).

POLICIES = ("undo", "keep")
CHANCE = 1e-4  # chance of telling offsets of runs that share one
LEAST_STEPS = 0.1  # spread between runs below which offsets are of no consequence [steps]
FEWEST = 2  # runs that can be compared
_LARGEST_S = 0.25  # standard error of an offset that says nothing


def differing(offsets: Mapping[str, Uncertain], *, step: float) -> dict[str, float] | None:
    """What to take out of each run where offsets differ by more than chance; None where one offset would do.

    By run: how late a channel is against another [s of the log]; negative where it is early. The `step` is in seconds.
    """
    offsets = {r: o for r, o in offsets.items() if np.isfinite(o.value) and 0 < o.error < _LARGEST_S}
    if len(offsets) < FEWEST:
        return None
    d, s = np.array([(o.value, o.error) for o in offsets.values()]).T
    weight = 1.0 / np.square(s)
    mean = float((weight * d).sum() / weight.sum())
    # errors of few degrees of freedom: the normal deviate that is as rare
    z = [-ndtri(stdtr(o.degrees, -abs(o.value - mean) / o.error)) for o in offsets.values()]
    between = _between(d, s)
    if chdtrc(len(offsets) - 1, float(np.square(z).sum())) > CHANCE or between**0.5 < LEAST_STEPS * step:
        return None
    weight = 1.0 / (between + np.square(s))
    mean = float((weight * d).sum() / weight.sum())
    return dict(zip(offsets, (mean + between * weight * (d - mean)).tolist(), strict=True))


def _between(d: Array, s: Array) -> float:
    """Variance between runs with which estimates scatter about their mean by as much as they should."""

    def excess(variance: float) -> float:
        weight = 1.0 / (variance + np.square(s))
        return float((weight * np.square(d - (weight * d).sum() / weight.sum())).sum()) - (len(d) - 1)

    most = float(np.square(d - d.mean()).sum()) + 1e-12
    return float(brentq(excess, 0.0, most)) if excess(0.0) > 0 else 0.0


def on_one_clock(data: DataSet, system: SystemInfo, *, policy: str = "undo") -> DataSet:
    """A data set whose streams are on one clock in every run, with a finding for each that was moved.

    The data set itself is returned where nothing differs.
    """
    if policy not in POLICIES:
        raise ConfigError(f"`stream_offsets` must be one of {', '.join(POLICIES)}; got {policy!r}.")
    done = any(finding.kind == "stream_offset" for finding in data.summary.findings)
    if policy == "keep" or done or len(data.runs) < FEWEST:
        return data
    runs, step = list(data.runs), data.runs[0].dt
    seen: dict[tuple[str, str], dict[str, Uncertain]] = {}
    for run in runs:
        for one in latencies(system, [run], clock=data.clock_scale):
            offset = Uncertain(-one.seconds, one.error, one.degrees)
            seen.setdefault((one.other, one.channel), {})[run.name] = offset
    findings, moved = [], set()
    for (channel, other), offsets in seen.items():
        taken = differing(offsets, step=step)
        if taken is None:
            continue
        mean = float(np.mean(list(taken.values())))  # of runs that cannot show their offset
        runs = [on_time(run, system, {channel: taken.get(run.name, mean)}) for run in runs]
        moved |= {f"{channel}_s", f"{other}_s"}
        each = [f"{run} {1e3 * d:+.3g} +- {1e3 * offsets[run].error:.2g} ms" for run, d in taken.items()]
        shown = ", ".join(each[:8]) + (f", ... ({len(each)} runs)" if len(each) > 8 else "")
        text = (
            f"{channel} is late against {other} by another time in each run, by the kinematics ({shown}; "
            "plus is late, minus early). `data.stream_offsets=keep` leaves them as they are"
        )
        values = {f"{run}_s": d for run, d in taken.items()}
        findings.append(Finding("stream_offset", "", len(taken), text, "taken out", values))
    if not findings:
        return data
    kept = [f for f in data.summary.findings if not (f.kind == "late_sensor" and set(f.values) <= moved)]
    return data.changed(runs, [*kept, *findings])
