"""Rows in which a sensor repeats itself though the machine moves: a log that froze, a sensor at its end.

A value that repeats exactly over several rows is no measurement where its partner in the kinematics says otherwise:

    | integral of (v - b) dt |  over the rows of a position that repeats
    | p(t + T) - p(t) - (v - b) T |  over those of a rate v that repeats

beyond 8 robust standard deviations of one step of `dp - (v - b) dt`, 6 of the integral of the rate's white noise, a few
quanta of the columns, and a small share of the usual travel in that time; `b` is the bias of the rate in the run. Where
all states repeat no partner can speak: that is a log that froze if it is noisy just before and just behind. Rows are
cut out. A column that holds most of its values, as one that is sampled more slowly, is left alone.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data.findings import Finding, Report
from nsde_torch.data.quaternion import increments
from nsde_torch.data.raw import RawRun, holes
from nsde_torch.data.system_info import SystemInfo, derivative_columns, rate_columns
from nsde_torch.recording.scatter import quantum, white
from nsde_torch.recording.times import GAP_STEPS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FEWEST = 5
"""Rows of one value that are looked at."""
_SIGMAS, _NOISE, _QUANTA, _SHARE = 8.0, 6.0, 5.0, 0.05
_MOST = 0.5  # share of rows that repeat; more is how the column was sampled
_NOISY, _GRAINS = (
    0.3,
    2.0,
)  # white noise over the usual change of a row, and over the steps that values come in
_FAINT = 1e-5  # share of a column's range that is rounding, no noise
_NEAR = 20  # rows on each side that show whether the log is noisy there
_MOVING = 50  # steps of a motion, fewest
_CLOSE = 5  # rows between two that are at an end


def cut(run: RawRun, system: SystemInfo, report: Report) -> None:
    """Drops rows of frozen logs and of sensors that repeat a value or stand at their end while the machine moves.

    Args:
        run: Without missing values and wraps; rows are dropped from it.
        system: Names, and which columns are derivatives of which.
        report: Takes the findings.
    """
    frozen = _frozen(run, system)
    if frozen.any():
        _tell(
            run, report, "frozen_rows", frozen, "all states repeat themselves, though the log is noisy there"
        )
        run.rows(~frozen)
    drop = np.zeros(len(run.t), dtype=bool)
    for name, column, bad in _contradicted(run, system):
        ends = {"lowest": column.min(), "highest": column.max()}
        for value in np.unique(column[bad]):
            which = next((word for word, end in ends.items() if value == end), None)
            rows = bad & (column == value)
            if which is None:
                continue
            bad = bad & ~rows
            rows = _closed(column == value)
            told = f"{name} stands at its {which} value {value:.6g}, while its partner moves on: the sensor's end"
            _tell(run, report, "sensor_end", rows, told, {"column": name, "value": float(value)})
            drop |= rows
        if bad.any():
            told = f"{name} repeats itself exactly, while its partner moves on"
            _tell(run, report, "frozen_rows", bad, told, {"column": name})
            drop |= bad
    if drop.any():
        run.rows(~drop)


def _tell(
    run: RawRun, report: Report, kind: str, rows: Mask, what: str, values: dict[str, object] | None = None
) -> None:
    parts = holes(rows)
    first = ", ".join(f"t = {run.t[a]:.6g} to {run.t[b - 1]:.6g} s" for a, b in parts[:3])
    count = int(rows.sum())
    message = f"{count} rows in which {what} ({first}{', ...' if len(parts) > 3 else ''})"
    report(Finding(kind, run.name, count, message, "dropped", {**(values or {}), "rows": parts[:100]}))


def _frozen(run: RawRun, system: SystemInfo) -> Mask:
    """Rows behind the first of those in which all states repeat, where the log is noisy on both sides."""
    x, out = run.x, np.zeros(len(run.x), dtype=bool)
    same = _repeats((np.diff(x, axis=0) == 0).all(1))
    if same.mean() > _MOST:
        return out
    rates = [b for _, j in derivative_columns(system).values() for b in j]
    changes = np.abs(np.diff(x, axis=0))
    usual = np.array([np.median(c[c > 0]) if (c > 0).any() else np.inf for c in changes.T])
    noise = np.array([white(column) for column in x.T])
    grain = np.array([quantum(column) for column in x.T])
    noisy = (noise > _NOISY * usual) & (noise > _GRAINS * grain) & (noise > _FAINT * np.ptp(x, axis=0))
    if not noisy.any() or not rates:
        return out
    for a, b in holes(same):
        sure = noisy & bool((x[a, rates] != 0).any())
        for part in (x[max(0, a - 1 - _NEAR) : a], x[b : b + _NEAR + 1]):
            sure &= len(part) > _NEAR // 2
            sure &= np.array([white(column) for column in part.T]) > 0.5 * noise
        out[a:b] = sure.any()
    return out


def _repeats(same: Mask) -> Mask:
    """Rows that repeat the one before, of stretches of `FEWEST` rows and more; from whether steps change nothing."""
    out = np.zeros(len(same) + 1, dtype=bool)
    for a, b in holes(same):
        if b - a + 1 >= FEWEST:
            out[a + 1 : b + 1] = True
    return out


def _closed(rows: Mask) -> Mask:
    """With what lies between two rows that are close to each other."""
    out = rows.copy()
    for a, b in holes(~rows):
        if a > 0 and b < len(rows) and b - a <= _CLOSE:
            out[a:b] = True
    return out


def _contradicted(run: RawRun, system: SystemInfo) -> Iterator[tuple[str, Array, Mask]]:
    """Of each position and rate: name, column, and rows that repeat while the partner moves."""
    x, names, steps = run.x, system.state_names, np.diff(run.t)
    for i, j in derivative_columns(system).values():
        for a, b in zip(i, j, strict=True):
            changes = np.diff(x[:, a])
            fine = quantum(x[:, a])
            yield (
                repr(names[a]),
                x[:, a],
                _false(changes == 0, changes, x[:, b], steps, fine, held_rate=False),
            )
            held = np.diff(x[:, b]) == 0
            yield repr(names[b]), x[:, b], _false(held, changes, x[:, b], steps, fine, held_rate=True)
    rates, q = rate_columns(system), system.quaternion
    if rates is not None and q is not None:
        turned = increments(x[:, q])
        fine = 2.0 * max(quantum(v) for v in x[:, q].T)
        for k, c in enumerate(range(rates.start, rates.stop)):
            held = np.diff(x[:, c]) == 0
            yield repr(names[c]), x[:, c], _false(held, turned[:, k], x[:, c], steps, fine, held_rate=True)


def _false(same: Mask, changes: Array, rate: Array, steps: Array, fine: float, *, held_rate: bool) -> Mask:
    """Rows (n,) of stretches that repeat, which the partner contradicts.

    Args:
        same: Whether a step changes nothing (n - 1,).
        changes: Of the position over the steps (n - 1,).
        rate: Its rate (n,).
        steps: Times between rows (n - 1,) [s].
        fine: Quantum of the position.
        held_rate: Whether it is the rate that repeats.
    """
    out = np.zeros(len(rate), dtype=bool)
    usual = float(np.median(steps))
    near = steps < GAP_STEPS * usual  # over gaps nothing can be said
    repeats = _repeats(same & near)
    moving = near & (changes != 0)
    if not repeats.any() or repeats.mean() > _MOST or moving.sum() < _MOVING:
        return out
    mean = 0.5 * (rate[1:] + rate[:-1])
    # what a position lost while it repeats, it makes up for afterwards; a rate does not
    fair = near & ~repeats[1:] if held_rate else near
    bias = -float((changes - steps * mean)[fair].sum()) / max(float(steps[fair].sum()), usual)
    rest = changes - steps * (mean - bias)
    sigma = 1.4826 * float(np.median(np.abs(rest[moving])))
    speed = float(np.quantile(np.abs(rate), 0.95))
    for a, b in holes(repeats):
        part = slice(a - 1, b - 1)  # steps from the first row of the stretch to its last
        travel = np.cumsum((steps * (mean - bias))[part])
        time = float(steps[part].sum())
        size = abs(float(rest[part].sum())) if held_rate else float(np.abs(travel).max())
        noise = 0.0 if held_rate else _NOISE * usual * white(rate) * (b - a) ** 0.5
        coarse = 2.0 * quantum(rate) * time if held_rate else 0.0
        if size > max(_SIGMAS * sigma, noise, _QUANTA * fine, coarse, _SHARE * speed * time):
            out[a:b] = True
    return out
