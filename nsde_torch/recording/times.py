"""One clock for a run: order, duplicates, gaps, dropped samples, and one uniform step in every segment."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data.findings import Finding, Report
from nsde_torch.data.quaternion import slerp
from nsde_torch.data.raw import RawRun
from nsde_torch.data.streams import disorder
from nsde_torch.errors import DataError

Array = NDArray[np.float64]

GAP_STEPS = 2.5
"""Steps without a row from which on the time between two rows is a gap, unless the caller says how long."""
JITTER = 0.05
"""Share of a step by which a row may lie off the uniform grid before the segment is resampled."""
LONGER = 1.5
"""Times the step of the log from which a step holds several rows."""
_WHOLE_RATE = 5e-4
_ROUNDED = 0.4
"""Share of a step by which the time between two rows may be off a whole number of steps, for the mean step."""


def order(run: RawRun, report: Report) -> None:
    """Rows with a time, each time once, in increasing order; a clock that starts again is refused.

    Raises:
        DataError: the clock goes back for good, or too many rows are out of order, or fewer than two are
            left.
    """
    timed = np.isfinite(run.t)
    if not timed.all():
        count = int((~timed).sum())
        report(Finding("missing_time", run.name, count, f"{count} rows without a time", "dropped"))
        run.rows(timed)
    back = np.flatnonzero(np.diff(run.t) < 0)
    if len(back):
        late, refused = disorder(run.t, "t")
        if refused:
            raise DataError(f"{run.where(int(back[0]) + 1)}: {refused}")
        report(Finding("out_of_order", run.name, late, f"{late} rows out of order in time", "sorted"))
        run.rows(np.argsort(run.t, kind="stable"))
    keep = np.concatenate([[True], np.diff(run.t) > 0])
    if not keep.all():
        count = int((~keep).sum())
        again = np.flatnonzero(~keep)
        differ = int((run.x[again] != run.x[again - 1]).any(axis=1).sum())
        report(
            Finding(
                "duplicate_time",
                run.name,
                count,
                f"{count} rows repeat a time ({differ} with other values); the first is kept",
                "dropped",
                {"differing": differ},
            )
        )
        run.rows(keep)
    if len(run.t) < 2:
        raise DataError(
            f"{run.source or 'run'} {run.name!r} has {len(run.t)} row(s) with a time of their own; a run "
            "needs at least two."
        )


def cuts_at_gaps(run: RawRun, *, gap: float, report: Report) -> NDArray[np.int64]:
    """Rows after which more than `gap` seconds pass without a row."""
    step = np.diff(run.t)
    cuts = np.flatnonzero(step > gap)
    if len(cuts):
        shown = ", ".join(f"{step[c]:.3g} s at t = {run.t[c]:.6g} s" for c in cuts[:3])
        report(
            Finding(
                "time_gap",
                run.name,
                len(cuts),
                f"{len(cuts)} gaps in time longer than {gap:.3g} s "
                f"({shown}{', ...' if len(cuts) > 3 else ''})",
                "split",
                {"missing_s": float(step[cuts].sum()), "rows": [int(c) for c in cuts[:100]]},
            )
        )
    return cuts


def follows(t: Array, dt: float) -> bool:
    """Whether times between gaps lie on grids of this step."""
    edges = [0, *(np.flatnonzero(np.diff(t) > 1.5 * dt) + 1).tolist(), len(t)]
    return all(is_uniform(t[a:b], dt) for a, b in itertools.pairwise(edges))


def mean_step(runs: Sequence[RawRun], about: float) -> float:
    """Mean step [s] of rows that are a few steps apart, `about` so long; a whole rate where it is one to 0.05 %."""
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

    Inputs are those of the nearest row; of steps that hold several rows the mean of what acted during the step.
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
        acted = u[
            np.where(share > 0.5 + 1e-6, left + 1, left)
        ]  # what acts over most of the step that follows
    extra = {k: np.interp(grid, t, v[start:stop]) for k, v in run.extra.items()}
    return RawRun(run.name, grid, x, acted, extra=extra, source=run.source)


def _mean_held(t: Array, u: Array, grid: Array, dt: float) -> Array:
    """Means (M, nu) over steps from `grid` of inputs (n, nu) that are held from row to row, the last beyond the end."""
    ends = np.append(t, max(t[-1], grid[-1]) + dt)
    done = np.concatenate((np.zeros((1, u.shape[1])), np.cumsum(u * np.diff(ends)[:, None], 0)))
    columns = [np.interp(grid + dt, ends, c) - np.interp(grid, ends, c) for c in done.T]
    return np.stack(columns, 1) / dt if columns else np.zeros((len(grid), 0))


def joined(pieces: list[RawRun]) -> RawRun:
    """Stretches of a run in one."""
    first = pieces[0]
    if len(pieces) == 1:
        return first
    return RawRun(
        first.name,
        np.concatenate([p.t for p in pieces]),
        np.concatenate([p.x for p in pieces]),
        np.concatenate([p.u for p in pieces]),
        extra={k: np.concatenate([p.extra[k] for p in pieces]) for k in first.extra},
        source=first.source,
    )


def uniform(
    run: RawRun, cuts: NDArray[np.int64], *, dt: float, quaternion: slice | None, report: Report
) -> tuple[RawRun, tuple[tuple[int, int], ...]]:
    """The run on the step `dt` in every segment between cuts; segments below two rows are left out.

    Returns:
        The run and its segments.

    Raises:
        DataError: no segment is left.
    """
    edges = np.concatenate([[0], np.asarray(cuts, dtype=np.int64) + 1, [len(run.t)]])
    bounds = [(int(a), int(b)) for a, b in itertools.pairwise(edges)]
    whole = [(a, b) for a, b in bounds if b - a >= 2 and run.t[b - 1] - run.t[a] >= dt * (1 - JITTER)]
    short = sum(b - a for a, b in bounds) - sum(b - a for a, b in whole)
    if short:
        report(
            Finding(
                "short_segment", run.name, short, f"{short} rows in segments shorter than one step", "dropped"
            )
        )
    if not whole:
        raise DataError(
            f"{run.source or 'run'} {run.name!r}: no two neighbouring rows are left within the gap limit; "
            "the recording is too sparse for the step. Raise `gap`, or set `dt` to its own step."
        )
    regular = [is_uniform(run.t[a:b], dt) for a, b in whole]
    run.t = run.t.copy()
    for (a, b), same in zip(whole, regular, strict=True):
        if same and not np.allclose(np.diff(run.t[a:b]), dt, rtol=1e-6, atol=0.0):  # times that were rounded
            run.t[a:b] = run.t[a] + dt * np.arange(b - a)
    if all(regular) and not short:
        return run, tuple(whole)
    pieces, segments, at, changed = [], [], 0, 0
    for (a, b), same in zip(whole, regular, strict=True):
        if same:
            extra = {k: v[a:b] for k, v in run.extra.items()}
            piece = RawRun(run.name, run.t[a:b], run.x[a:b], run.u[a:b], extra=extra, source=run.source)
        else:
            piece = resample(run, a, b, dt=dt, quaternion=quaternion)
            changed += 1
        pieces.append(piece)
        segments.append((at, at + len(piece.t)))
        at += len(piece.t)
    if changed:
        inside = np.concatenate(
            [np.diff(run.t[a:b]) for (a, b), same in zip(whole, regular, strict=True) if not same]
        )
        missing = int(np.maximum(np.rint(inside / dt) - 1, 0).sum())
        report(
            Finding(
                "non_uniform_step",
                run.name,
                changed,
                f"{changed} of {len(whole)} segments off the step of {dt * 1e3:.4g} ms (steps "
                f"{inside.min() * 1e3:.4g} to {inside.max() * 1e3:.4g} ms, {missing} samples dropped)",
                "resampled",
                {
                    "step_min_s": float(inside.min()),
                    "step_max_s": float(inside.max()),
                    "dropped_samples": missing,
                },
            )
        )
    return joined(pieces), tuple(segments)
