"""One clock for a run: order, duplicates, missing values, gaps, dropped samples, and one uniform step in every segment.

A longer step than that of the log is taken after the log was looked at at its own rate: states are those of the log at
the new times, inputs the mean during a step. What is late by less than a step cannot be seen in the new
rows, nor distinguished from physics: it is taken out before.
"""

import itertools
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from math import inf

import numpy as np

from nsde_torch.arrays import Array, Labels
from nsde_torch.data.pace import typical_time
from nsde_torch.data.quaternion import slerp
from nsde_torch.data.raw import Finding, RawRun, Report, holes
from nsde_torch.data.run import DataSet, Run
from nsde_torch.data.streams import disorder, unrounded
from nsde_torch.data.summary import data_set_of
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.errors import DataError
from nsde_torch.recording.latency import Latency, latency_findings, on_time
from nsde_torch.recording.noise import cubic

GAP_STEPS = 2.5
"""Steps without a row from which on the time between two rows is a gap, unless the caller says how long."""
JITTER = 0.05  # share of a step by which a row may lie off the uniform grid before the segment is resampled
_TO_JUDGE = 100  # rows of a segment at least whose times are held against even ones
_SMOOTHER = 20.0  # nats: noise of neighbouring rows is not independent
LONGER = 1.5  # times the step of the log from which a step holds several rows
FINEST_S = 0.005
"""Time into which rows of fast logs are taken together [s]: at 1 kHz a diagnosis had found nothing in 10 minutes."""
_IN_A_TYPICAL_TIME = 60.0
"""Rows that stay in a typical time of the states: a lag of 0.2 ms of a spring that moves in 6 ms was lost in 0.4 ms."""
_ENOUGH = 1000
"""Rows that such a log keeps: a short one has no time to win (tests/diagnosis/test_not_done.py, 60 rows at 2 kHz)."""
LONG = 1_500_000
"""Numbers of states and inputs that are used of a log. Of one hour (360,006 rows) a spring's diagnosis took 4.3 GB; a
hexacopter's training took 3.3 GB of ten minutes (60,000 rows)."""
_STRETCH_S, _SHORTEST_S = 30.0, 3.0  # a stretch of a longer log, and the least that is used of a run
_WHOLE_RATE = 5e-4
_ROUNDED = 0.4
"""Share of a step by which the time between two rows may be off a whole number of steps, for the mean step."""


def order(run: RawRun, report: Report) -> None:
    """Rows with a time, each time once, in increasing order.

    A DataError refuses a clock that starts again, too many rows out of order, or fewer than two that are left.
    """
    timed = np.isfinite(run.t)
    dropped = int((~timed).sum())
    if dropped:
        report(Finding("missing_time", run.name, dropped, f"{dropped} rows without a time", "dropped"))
        run.rows(timed)
    back = np.flatnonzero(np.diff(run.t) < 0)
    if len(back):
        late, refused = disorder(run.t, "t")
        if refused:
            raise DataError(f"{run.where(int(back[0]) + 1)}: {refused}")
        report(Finding("out_of_order", run.name, late, f"{late} rows out of order in time", "sorted"))
        run.rows(np.argsort(run.t, kind="stable"))
    even = unrounded(run.t, np.concatenate((run.x, run.u), axis=1))
    if even is not None:
        text = (
            f"{len(run.t)} rows have {len(np.unique(run.t))} times: the clock ticks slower than rows came, and they "
            f"are taken to be {np.diff(even)[0] * 1e3:.4g} ms apart"
        )
        report(Finding("rounded_time", run.name, len(run.t), text, "spread"))
        run.t = even
    again = np.flatnonzero(np.diff(run.t, prepend=-np.inf) <= 0)
    if len(again):
        differ = int((run.x[again] != run.x[again - 1]).any(axis=1).sum())
        text = f"{len(again)} rows repeat a time ({differ} with other values); the first is kept"
        report(Finding("duplicate_time", run.name, len(again), text, "dropped", {"differing": differ}))
        run.rows(np.delete(np.arange(len(run.t)), again))
    if len(run.t) < 2:
        raise DataError(
            f"{run.label} has {len(run.t)} row(s) with a time `t` of their own ({dropped} without a time); a run needs "
            "at least two."
        )


def fill_missing(run: RawRun, system: SystemInfo, *, gap: float, report: Report) -> None:
    """Fills holes between rows at most `gap` seconds apart (states linear, inputs held); drops other rows.

    Dropped rows leave a step in time longer than `gap`, at which the run is then cut. Slow further channels,
    such as a battery voltage logged at 1 Hz, are interpolated over any hole. A column without any value is refused.
    """
    bad_x, bad_u = np.isnan(run.x), np.isnan(run.u)
    for names, bad, data in ((system.state_names, bad_x, run.x), (system.input_names, bad_u, run.u)):
        empty = np.flatnonzero(bad.all(axis=0))
        if len(data) and len(empty):
            raise DataError(
                f"{run.label}: {names[int(empty[0])]!r} has no value in any row; record the channel, or leave the run "
                "out."
            )
    extra = dict(run.extra)
    for name, channel in run.extra.items():
        bad = np.isnan(channel)
        if bad.all():
            del extra[name]
            text = f"channel {name!r} has no value"
            report(Finding("empty_channel", run.name, len(channel), text, "dropped"))
        elif bad.any():
            extra[name] = np.interp(run.t, run.t[~bad], channel[~bad])
            text = f"channel {name!r} is missing in {float(bad.mean()):.1%} of the rows"
            report(Finding("missing_channel", run.name, int(bad.sum()), text, "interpolated"))
    run.extra = extra
    row_bad = bad_x.any(axis=1) | bad_u.any(axis=1)
    if not row_bad.any():
        return
    n = len(run.t)
    drop = np.zeros(n, dtype=bool)
    for a, b in holes(np.asarray(row_bad)):
        drop[a:b] = a == 0 or b == n or run.t[b] - run.t[a - 1] > gap
    good, some = ~row_bad, row_bad & ~drop
    filled = int(some.sum())
    if filled:
        run.x, run.u = run.x.copy(), run.u.copy()
        for k, bad in enumerate(bad_x.T):
            mend = some & bad
            run.x[mend, k] = np.interp(run.t[mend], run.t[good], run.x[good, k])
        if (q := system.quaternion) is not None:  # back to the sphere, which lines leave
            norm = np.linalg.norm(run.x[:, q], axis=1)
            off = np.abs(norm - 1.0) > 1e-6
            run.x[off, q] /= norm[off, None]
        last_good = np.maximum.accumulate(np.where(good, np.arange(n), 0))
        for k, bad in enumerate(bad_u.T):
            run.u[some & bad, k] = run.u[last_good[some & bad], k]
        text = f"{filled} rows with missing values in holes up to {gap:.3g} s"
        report(Finding("missing_values", run.name, filled, text, "interpolated"))
    if drop.any():
        count = int(drop.sum())
        text = f"{count} rows with missing values at the ends or in holes longer than {gap:.3g} s"
        report(Finding("missing_rows", run.name, count, text, "dropped"))
        run.rows(~drop)
    if len(run.t) < 2:
        raise DataError(
            f"{run.label}: fewer than two rows have all states and inputs. Resample "
            "the channels onto one clock before writing them, one row a sample."
        )


def cuts_at_gaps(run: RawRun, *, gap: float, report: Report) -> Labels:
    """Rows after which more than `gap` seconds pass without a row."""
    step = np.diff(run.t)
    cuts = np.flatnonzero(step > gap)
    if len(cuts):
        shown = ", ".join(f"{step[c]:.3g} s at t = {run.t[c]:.6g} s" for c in cuts[:3])
        text = f"{len(cuts)} gaps in time longer than {gap:.3g} s ({shown}{', ...' if len(cuts) > 3 else ''})"
        values = {"missing_s": float(step[cuts].sum()), "rows": [int(c) for c in cuts[:100]]}
        report(Finding("time_gap", run.name, len(cuts), text, "split", values))
    return cuts


def follows(t: Array, dt: float) -> bool:
    """Whether times between gaps lie on grids of this step."""
    edges = [0, *(np.flatnonzero(np.diff(t) > 1.5 * dt) + 1).tolist(), len(t)]
    return all(is_uniform(t[a:b], dt) for a, b in itertools.pairwise(edges))


def _even(t: Array) -> Array | None:
    """Even times nearest to those of some rows (n,), of which each is less than half a step away; else None."""
    rows = np.arange(len(t), dtype=float)
    slope, first = np.polyfit(rows, t - t[0], 1)
    out = t[0] + first + slope * rows
    return np.asarray(out) if np.abs(t - out).max() <= 0.5 * slope else None


def mean_step(runs: Sequence[RawRun], about: float) -> float:
    """Mean step [s] of rows that are a few steps apart, `about` so long; a whole rate where it is one to 0.05 %."""
    lines = [line for run in runs if (line := _even(run.t)) is not None]
    if len(lines) == len(runs):  # no row is missing, and times may jitter by more than some steps
        mean = sum(float(line[-1] - line[0]) for line in lines) / sum(len(line) - 1 for line in lines)
    else:
        steps = np.concatenate([np.diff(run.t) for run in runs])
        count = np.rint(steps / about)
        near = (np.abs(steps / about - count) < _ROUNDED) & (count >= 1) & (count < GAP_STEPS)
        if not near.any():
            return about
        mean = float(steps[near].sum() / count[near].sum())
    whole = round(1.0 / mean)
    return round(1.0 / whole, 12) if whole and abs(mean * whole - 1.0) < _WHOLE_RATE else round(mean, 12)


def is_uniform(t: Array, dt: float) -> bool:
    """Whether all rows lie within `JITTER` steps of a grid of step `dt` from the first."""
    return bool(np.abs(t - t[0] - dt * np.arange(len(t))).max() <= JITTER * dt)


def resample(run: RawRun, start: int, stop: int, *, dt: float, quaternion: slice | None) -> RawRun:
    """Rows start..stop on a uniform grid: states linear (quaternion slerp).

    Inputs are those of the nearest row; for steps that hold several rows, the mean during the step.
    """
    t = run.t[start:stop]
    count = int(np.floor((t[-1] - t[0]) / dt * (1 + 1e-12) + 1e-6)) + 1
    grid = t[0] + dt * np.arange(count)
    left = np.clip(np.searchsorted(t, grid + 1e-6 * dt, side="right") - 1, 0, len(t) - 2)
    share = np.clip((grid - t[left]) / (t[left + 1] - t[left]), 0.0, 1.0)
    x0, x1 = run.x[start:stop][left], run.x[start:stop][left + 1]
    x = x0 + share[:, None] * (x1 - x0)
    if quaternion is not None:
        x[:, quaternion] = slerp(x0[:, quaternion], x1[:, quaternion], share)
    u = run.u[start:stop]
    if dt > LONGER * float(np.median(np.diff(t))):
        acted = _mean_held(t, u, grid, dt)
    else:
        acted = u[np.where(share > 0.5 + 1e-6, left + 1, left)]  # over most of the step that follows
    extra = {k: np.interp(grid, t, v[start:stop]) for k, v in run.extra.items()}
    return RawRun(run.name, grid, x, acted, extra=extra, source=run.source)


def _mean_held(t: Array, u: Array, grid: Array, dt: float) -> Array:
    """Means (M, nu) over steps from `grid` of inputs (n, nu) that are held from row to row, the last beyond the end."""
    ends = np.append(t, max(t[-1], grid[-1]) + dt)
    done = np.concatenate((np.zeros((1, u.shape[1])), np.cumsum(u * np.diff(ends)[:, None], 0)))
    columns = [np.interp(grid + dt, ends, c) - np.interp(grid, ends, c) for c in done.T]
    return np.stack(columns, 1) / dt if columns else np.zeros((len(grid), 0))


def joined(pieces: Sequence[RawRun]) -> tuple[RawRun, tuple[tuple[int, int], ...]]:
    """Stretches of a run in one, and where each is in it."""
    first, ends = pieces[0], np.cumsum([len(p.t) for p in pieces]).tolist()
    segments = tuple(zip([0, *ends[:-1]], ends, strict=True))
    if len(pieces) == 1:  # a long recording must not be held twice
        return first, segments
    t, x, u = (np.concatenate([getattr(p, column) for p in pieces]) for column in "txu")
    extra = {k: np.concatenate([p.extra[k] for p in pieces]) for k in first.extra}
    return RawRun(first.name, t, x, u, extra=extra, source=first.source), segments


def uniform(
    run: RawRun, cuts: Labels, *, dt: float, quaternion: slice | None, report: Report
) -> tuple[RawRun, tuple[tuple[int, int], ...]]:
    """The run on the step `dt` in every segment between cuts, and its segments; those below two rows are left out."""
    bounds = list(itertools.pairwise([0, *(cuts + 1).tolist(), len(run.t)]))
    whole = [(a, b) for a, b in bounds if b - a >= 2 and run.t[b - 1] - run.t[a] >= dt * (1 - JITTER)]
    short = sum(b - a for a, b in bounds) - sum(b - a for a, b in whole)
    if short:
        text = f"{short} rows in segments shorter than one step"
        report(Finding("short_segment", run.name, short, text, "dropped"))
    if not whole:
        raise DataError(
            f"{run.label}: no two neighbouring rows are left within the gap limit; "
            "the recording is too sparse for the step. Raise `gap`, or set `dt` to its own step."
        )
    run.t = run.t.copy()
    jitter = [_evenly(run, a, b, dt) for a, b in whole]
    if any(jitter):
        text = (
            f"times are off an even step by up to {max(jitter) * 1e3:.2g} ms, and what was measured is not: it is "
            "smoother over its rows than over its times"
        )
        found = sum(j > 0 for j in jitter)
        report(Finding("jittered_times", run.name, found, text, "even", {"most_s": max(jitter)}))
    regular = [is_uniform(run.t[a:b], dt) for a, b in whole]
    for (a, b), same in zip(whole, regular, strict=True):
        if same and not np.allclose(np.diff(run.t[a:b]), dt, rtol=1e-6, atol=0.0):  # times that were rounded
            run.t[a:b] = run.t[a] + dt * np.arange(b - a)
    if all(regular) and not short:
        return run, tuple(whole)
    pieces, steps = [], []  # of those that were resampled
    for (a, b), same in zip(whole, regular, strict=True):
        if same:
            pieces.append(replace(run))
            pieces[-1].rows(slice(a, b))
        else:
            pieces.append(resample(run, a, b, dt=dt, quaternion=quaternion))
            steps.append(np.diff(run.t[a:b]))
    if steps:
        inside = np.concatenate(steps)
        # by the time that they take: steps that jitter are long and short
        missing = sum(max(round(float(own.sum()) / dt) - len(own), 0) for own in steps)
        low, high = inside.min(), inside.max()
        text = (
            f"{len(steps)} of {len(whole)} segments off the step of {dt * 1e3:.4g} ms (steps {low * 1e3:.4g} to "
            f"{high * 1e3:.4g} ms, {missing} samples dropped)"
        )
        values = {"step_min_s": float(low), "step_max_s": float(high), "dropped_samples": missing}
        report(Finding("non_uniform_step", run.name, len(steps), text, "resampled", values))
    return joined(pieces)


def _evenly(run: RawRun, a: int, b: int, dt: float) -> float:
    """How far times of a segment [s] were off even ones, which they are now; 0 where they stay.

    Where a computer notes when a row arrived, and a sensor measured in time, values are smoother over their rows than
    over their times. On its times a ball on a table of which nothing was missing was `unexplained`.
    """
    even = None if b - a < _TO_JUDGE or is_uniform(run.t[a:b], dt) else _even(run.t[a:b])
    if even is None:
        return 0.0
    most = float(np.abs(run.t[a:b] - even).max())
    at_times, at_rows = (_roughness(t, run.x[a:b]) for t in (run.t[a:b], even))
    moves = at_rows > 0
    smoother = 0.5 * (b - a) * float(np.log(at_times[moves] / at_rows[moves]).sum())
    if not smoother > _SMOOTHER:
        return 0.0
    run.t[a:b] = even
    return most


def _roughness(t: Array, x: Array) -> Array:
    """Mean squares (nx,) of what cubics through two rows before and two behind leave of each, of equal noise."""
    left, size = x[2:-2].copy(), np.ones((len(t) - 4, 1))
    for beside, weight in cubic(t):
        left -= weight[:, None] * x[beside]
        size += weight[:, None] ** 2
    return np.asarray((left**2 / size).mean(0))


def is_longer(dt: float | None, own: float) -> bool:
    """Whether a step that was asked for holds several rows of the log."""
    return dt is not None and dt > LONGER * own


def on_longer_step(data: DataSet, system: SystemInfo, dt: float, *, late: Sequence[Latency] = ()) -> DataSet:
    """The data set on a longer step `dt` [s]; `late` channels are moved first, if runs are long enough for it."""
    findings, runs = list(data.summary.findings), list(data.runs)
    if late:
        delays, lags = ({d.channel: d.seconds for d in late if d.filtered == f} for f in (False, True))
        with suppress(DataError):
            runs = [on_time(run, system, delays, lags) for run in runs]
            findings = [f for f in findings if f.kind != "late_sensor"]
            findings += latency_findings(late, action="taken out")
    runs = [_resampled(run, system, dt) for run in runs]
    return _holding(data, system, runs, findings, dt)


def _holding(
    data: DataSet, system: SystemInfo, runs: Sequence[Run], findings: Sequence[Finding], dt: float
) -> DataSet:
    """The data set with other runs and findings, on a step."""
    rank, slopes = data.summary.input_rank, data.summary.slopes
    own = {"dt": dt, "clock_scale": data.clock_scale}
    return data_set_of(runs, system, kind=data.kind, slopes=slopes, rank=rank, findings=findings, **own)


def no_finer(data: DataSet, system: SystemInfo, most: float = inf) -> DataSet:
    """The data set with as many rows of a long log in one as fit into 5 ms, which is then one of its findings.

    And into `most` [s]: of a spring that oscillates at 160 Hz, logged at 5 kHz, nothing was found in rows of 4.8 ms.
    """
    most = min(most, FINEST_S * data.runs[0].pace, typical_time(data.runs) / _IN_A_TYPICAL_TIME)
    fit = int(most / (data.dt * data.clock_scale) + _ROUNDED)
    every = min(fit, sum(len(run) for run in data.runs) // _ENOUGH)
    if every < LONGER:
        return data
    text = f"rows {data.dt * 1e3:.4g} ms apart are closer than is needed: {every} of them are one"
    finding = Finding("short_step", "", every, text, "resampled", {"step_s": data.dt, "rows": every})
    told = replace(data.summary, findings=(*data.summary.findings, finding))
    return on_longer_step(replace(data, summary=told), system, every * data.dt)


def no_longer(data: DataSet, system: SystemInfo, most: float) -> DataSet:
    """The data set with at most about so many rows, in stretches spread evenly over each run, which is a finding."""
    rows = sum(b - a for run in data.runs for a, b in run.segments)
    if rows <= most:
        return data
    runs = [_thinned(run, most / rows) for run in data.runs]
    kept = sum(map(len, runs))
    text = (
        f"{rows:,} rows are more than a training or a diagnosis holds in memory: {kept:,} of them are used, in "
        f"stretches spread over each run (data.most_rows=N for another number)"
    )
    finding = Finding("long_log", "", rows, text, "left out", {"rows": rows, "used": kept})
    return _holding(data, system, runs, (*data.summary.findings, finding), data.dt)


def _thinned(run: Run, share: float) -> Run:
    """A run with that share of its rows, or with a few seconds of it if that is longer."""
    used = np.concatenate([np.arange(a, b) for a, b in run.segments])
    few = min(max(share * len(used), _SHORTEST_S * run.pace / run.dt), len(used))
    count = max(1, round(few * run.dt / (_STRETCH_S * run.pace)))
    firsts = np.linspace(0, len(used) - few / count, count).round().astype(int)
    at = np.concatenate([used[first : first + max(int(few / count), 2)] for first in firsts])
    last = np.zeros(len(run), dtype=bool)
    last[[b - 1 for _, b in run.segments]] = True  # a gap is behind them, though the next number follows
    broken = np.append((np.diff(at) != 1) | last[at[:-1]], True)
    cuts = [0, *(np.flatnonzero(broken) + 1).tolist()]
    segments = tuple((a, b) for a, b in itertools.pairwise(cuts) if b - a >= 2)
    extra = {name: values[at] for name, values in run.extra.items()}
    return replace(run, t=run.t[at], x=run.x[at], u=run.u[at], extra=extra, segments=segments, unbroken=())


def _resampled(run: Run, system: SystemInfo, dt: float) -> Run:
    nu = len(system.input_names)
    raw = RawRun(run.name, run.t, run.x, run.u[:, :nu], extra=dict(run.extra), source=run.source)
    long = [(a, b) for a, b in run.segments if run.t[b - 1] - run.t[a] >= dt * (1 - JITTER)]
    if not long:
        raise DataError(
            f"{raw.label}: no stretch without a gap is as long as the step of {dt:.4g} s. Set "
            "`dt` to a shorter one."
        )
    whole, segments = joined([resample(raw, a, b, dt=dt, quaternion=system.quaternion) for a, b in long])
    u = whole.u
    if system.exogenous:
        u = np.column_stack([u, *(whole.extra[name] for name in system.exogenous)])
    return replace(run, t=whole.t, x=whole.x, u=u, extra=whole.extra, segments=segments, unbroken=())
