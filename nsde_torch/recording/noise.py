"""The noise of a column from row to row: its size, samples that are no part of it, and lines that have none.

    d[k] = x[k] - (4 (x[k-1] + x[k+1]) - (x[k-2] + x[k+2])) / 6        in equal steps, Lagrange's weights else

is what a cubic through the neighbours leaves of a sample. A glitch exceeds 8 robust standard deviations of its column,
4 times the 90 % quantile of its neighbourhood without glitches, and 4 usual changes from row to row (a kink, as where a
force changes its sign, does not); with it taken out, or with another one of the four rows around it, its neighbours
fit, which rules out a step; and it is no motion: a position whose rate goes the same way is kept. What was off is put
on the cubic.

A rotor at speed n pulls with k n^2 (momentum theory), so that the share of its thrust is u = (n / n_max)^2. It has
inertia: where a value leaves what lies on both sides of it for a few rows, by more than a tenth of n_max and by 8 times
what the column usually changes in that time, the line was noisy, and the value is put between its neighbours.

Sensors have noise on every row. Where most second differences of a column, x_{k+1} - 2 x_k + x_{k-1}, are next to
nothing beside those of the other rows, the knots, the column was resampled by linear interpolation, and what looks like
a rate of the log is not that of the sensor (docs/content/theory/recording.md).
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.ndimage import percentile_filter

from nsde_torch.arrays import Array, Mask
from nsde_torch.data.raw import Finding, RawRun, Report
from nsde_torch.data.system_info import SystemInfo, rate_pairs
from nsde_torch.errors import DataError

_CURVE = 1.39  # what a cubic leaves of white noise, over its standard deviation
_DIGITS, _SOME = 8, 2000  # most significant digits that are few, and values that are looked at
SIGMAS, ISOLATION, CHANGES = 8.0, 4.0, 4.0
NEIGHBOURHOOD = 25  # rows on each side against which a sample is judged
_GLITCH_QUANTA, _RANGE = 3.0, 0.01  # of the steps that values come in, and of their range
_LEFT = 0.3  # share of a glitch that its neighbours may be off without it
_MOST = 0.02  # share of the rows; more is how the sensor is
_MISSING = 2.5  # steps that rows around a glitch may be apart (a cart with 3 % of its rows missing)

_LEAVES, _USUAL = 0.1, 8.0  # of the largest speed, and of the column's usual change
_BEYOND = 1.2  # share of the largest speed beyond which a value is no speed, however long it lasts
_LONGEST, _AROUND = 4, 5  # rows of a glitch at most (two, held at half the rate), and rows on each side
_MOST_ROTOR = 0.05  # share of rows; more is how the column is
_FEWEST = 200
_NOTHING, _ROUNDED, _MOST_ROUNDED = 1e-3, 2.0, 0.02
"""Second differences, over the large ones, that count as none: lines are straight to the digits of the log, or, of a
quaternion, but for its norm; those that rounding makes, in steps that the values come in, up to a share of the large
ones. A motion without noise under forces that are held is smooth between its kinks, and not straight."""
_SHARE = (0.4, 0.985)
"""Shares of rows without curvature between which a column was interpolated; 0.5 where every second row was, and above
0.985 it is a motion at a steady rate."""
_QUANTA, _ROUNDING = 10.0, 1e-8
"""Large second differences are at least so many steps that the values come in, and that share of the largest value."""
_MOVES = 0.2
"""Steps from row to row, over the large ones, that count as a motion: a coarse sensor stands still in between."""


def off_curve(x: Array, t: Array | None = None) -> Array:
    """What a cubic through the two neighbours on each side leaves of samples (n,); 0 at the ends.

    At times (n,), or at equal distances.
    """
    out = np.zeros_like(x)
    if t is None:
        out[2:-2] = x[2:-2] - (4.0 * (x[1:-3] + x[3:-1]) - (x[:-4] + x[4:])) / 6.0
        return out
    out[2:-2] = x[2:-2]
    for beside, weight in cubic(t):
        out[2:-2] -= weight * x[beside]
    return out


def cubic(t: Array) -> list[tuple[slice, Array]]:
    """The four neighbours of rows at times (n,), and their weights (n - 4,) in the cubic through them."""
    beside = [slice(2 + k, len(t) - 2 + k) for k in (-2, -1, 1, 2)]
    out = []
    for one in beside:  # Lagrange's polynomials
        others = [other for other in beside if other != one]
        out.append((one, np.prod([(t[2:-2] - t[other]) / (t[one] - t[other]) for other in others], 0)))
    return out


def white(x: Array) -> float:
    """Robust standard deviation of the white noise of a column [its unit]; nothing below five samples."""
    return 1.4826 / _CURVE * float(np.median(np.abs(off_curve(x)[2:-2]))) if len(x) > 4 else 0.0


def quantum(x: Array) -> float:
    """The step that values of a column come in [its unit]; the median of `grains`, 0 where there is none."""
    return float(np.median(grains(x))) if len(x) else 0.0


def grains(x: Array) -> Array:
    """The step that each value (n,) of a column comes in [its unit]: the smallest distance of two, beyond rounding.

    Where values were written with some significant digits the smallest of them come in smaller steps than the others;
    it is then the last digit of each.
    """
    steps = np.diff(np.unique(x))
    steps = steps[steps > 1e-9 * max(float(np.abs(x).max(initial=0.0)), 1e-300)]
    if not len(steps):
        return np.zeros_like(x)
    size = np.abs(x)
    place = np.floor(np.log10(np.maximum(size, 1e-300)))
    some = np.flatnonzero(size > 0)
    some = some[:: max(1, len(some) // _SOME)]
    for digits in range(1, _DIGITS + 1):
        last = 10.0 ** (place - digits + 1)
        off = size[some] / last[some]
        if (np.abs(off - np.round(off)) < 1e-3 * 10.0 ** (digits - _DIGITS)).all():
            return np.maximum(last, float(steps.min()))
    return np.full_like(x, float(steps.min()))


def mend_glitches(run: RawRun, system: SystemInfo, report: Report) -> None:
    """Puts single samples that are off by far on the curve through their neighbours; runs have no holes and wraps."""
    n = len(run.t)
    if n < 2 * NEIGHBOURHOOD:
        return
    partners = dict(rate_pairs(system))
    q = range(n)[:0] if system.quaternion is None else range(run.x.shape[1])[system.quaternion]
    turned = False
    for k, name in enumerate(system.state_names):
        rate = partners.get(k)
        column, off = _mended(run.x[:, k], None if rate is None else run.x[:, rate], run.t)
        if not off or len(off) > _MOST * n:
            continue
        run.x = run.x.copy()
        run.x[:, k] = column
        turned = turned or k in q
        rows = sorted(off)
        shown = ", ".join(f"{off[row]:+.3g} in row {row}" for row in rows[:3])
        shown += ", ..." if len(rows) > 3 else ""
        text = f"{len(rows)} single samples of {name!r} off by far ({shown})"
        values = {"column": name, "rows": rows, "sizes": [off[row] for row in rows]}
        report(Finding("glitch", run.name, len(rows), text, "interpolated", values))
    if turned:
        run.x[:, system.quaternion] /= np.linalg.norm(run.x[:, system.quaternion], axis=1, keepdims=True)


def _near(t: Array) -> Mask:
    """Whether no more than one row is missing between any two of a row and the two on each side."""
    step = np.diff(t)
    good = step < _MISSING * np.median(step)
    out = np.zeros(len(t), dtype=bool)
    out[2:-2] = good[:-3] & good[1:-2] & good[2:-1] & good[3:]
    return out


def _mended(column: Array, rate: Array | None, t: Array) -> tuple[Array, dict[int, float]]:
    """The column without glitches, and their sizes by row."""
    near, size, changes = _near(t), np.abs(off_curve(column, t)), np.abs(np.diff(column))
    off: dict[int, float] = {}
    if not (changes > 0).any() or not near.any():
        return column, off
    usual_change = float(np.quantile(changes, 0.95))
    # of a pole that spins each change is as large as a glitch, and what its rate makes of it is not
    if rate is not None:
        against = np.abs(np.diff(column) - 0.5 * np.diff(t) * (rate[1:] + rate[:-1]))
        usual_change = min(usual_change, float(np.quantile(against, 0.95)))
    least = max(
        SIGMAS * 1.4826 * float(np.median(size[near])),
        CHANGES * usual_change,
        _GLITCH_QUANTA * quantum(column),
        _RANGE * float(np.ptp(column)),
    )
    candidates = np.flatnonzero(near & (size > least))
    if not len(candidates):
        return column, off
    column = column.copy()
    for k in candidates[np.argsort(-size[candidates])].tolist():
        # of two within four rows each spoils the neighbours of the other, and of two in a row neither stands out
        beside = {k - 1, k + 1, *(int(j) for j in candidates if abs(j - k) <= 4)} - {k, *off}
        for rows in () if k in off else ([k], *([k, j] for j in sorted(beside, key=lambda j: -size[j]))):
            found = _off(column, t, rows, least)
            if not found or (
                rate is not None and any(_moves(column, by, rate, t, j) for j, by in found.items())
            ):
                continue
            for j, by in found.items():
                column[j] -= by
                off[j] = by
            break
    # the neighbourhood without them: of three in a second none stood out (a cart of which 1 % of samples were off)
    left = np.abs(off_curve(column, t))
    usual = percentile_filter(left, 90, size=2 * NEIGHBOURHOOD + 1, mode="nearest")
    for k in [k for k, by in off.items() if abs(by) <= ISOLATION * usual[k]]:
        column[k] += off.pop(k)
    return column, off


def _off(column: Array, t: Array, rows: Sequence[int], least: float) -> dict[int, float]:
    """By how much rows are off the curve through their neighbours; empty where these do not fit without them."""
    first, end = max(min(rows) - 4, 0), max(rows) + 5
    without, times = column[first:end].copy(), t[first:end]
    good = np.delete(np.arange(len(without)), [k - first for k in rows])
    out = {}
    for k in rows:
        place = int(np.searchsorted(good, k - first))
        some = good[max(place - 2, 0) : place + 2]
        if len(some) < 4:
            return {}
        around = np.insert(without[some], 2, without[k - first]), np.insert(times[some], 2, times[k - first])
        out[k] = float(off_curve(*around)[2])
        back = abs(float(np.diff(without[some[1:3]])[0]))
        if abs(out[k]) <= least or back > _LEFT * abs(out[k]) + least / SIGMAS * 3:
            return {}
    for k, by in out.items():
        without[k - first] -= by
    left, looked = np.abs(off_curve(without, times)), [k - first for k in rows]
    most = left[max(min(looked) - 2, 0) : max(looked) + 3].max()
    smallest = min(abs(by) for by in out.values())
    return {} if most > _LEFT * smallest + least / SIGMAS * 3 else out


def _moves(position: Array, off: float, rate: Array, t: Array, k: int) -> bool:
    """Whether the rate says that the position went there and back."""
    step, rates = np.diff(t[k - 1 : k + 2]), rate[k - 1 : k + 1] + rate[k : k + 2]
    gap = np.diff(position[k - 1 : k + 2]) - 0.5 * step * rates
    mended = gap - np.array([off, -off])
    return float(gap @ gap) < float(mended @ mended)


def shares(speed: Array, most: float, *, name: str, where: str) -> tuple[Array, list[int]]:
    """Shares of the largest thrust (n,) from speeds, in the unit of `most` of full thrust; and rows that were glitches.

    A DataError refuses speeds that are not of this range, or more glitches than a column has.
    """
    seen = speed[np.isfinite(speed)]
    if not len(seen):
        return speed, []
    usual = float(np.quantile(np.abs(seen), 0.9))
    if not 0.05 * most < usual < _BEYOND * most:
        raise DataError(
            f"{where}: rotor speed {name!r} is at most {usual:.4g} in nine rows of ten, where {most:.4g} is full "
            "thrust. Give `data.rotor_speed` in the unit of the column (electrical turns are the rotor's times its "
            "pole pairs)."
        )
    bad = rotor_glitches(speed, most)
    if bad.mean() > _MOST_ROTOR:
        raise DataError(
            f"{where}: {bad.mean():.0%} of the rows of rotor speed {name!r} are beyond {_BEYOND:g} times {most:.4g}, "
            "or leave their neighbours by more than a rotor can. Expected at most "
            f"{_MOST_ROTOR:.0%}; check the column, and `data.rotor_speed`."
        )
    rows, good = np.arange(len(speed)), np.isfinite(speed) & ~bad
    mended = speed.copy()
    mended[bad] = np.interp(rows[bad], rows[good], speed[good])
    return np.square(np.maximum(mended, 0.0) / most), np.flatnonzero(bad).tolist()


def rotor_glitches(speed: Array, most: float) -> Mask:
    """Rows (n,) of a column of speeds, nan where there is none, that a rotor of at most `most` cannot have had."""
    n = len(speed)
    bad: Mask = np.isfinite(speed) & ((np.abs(speed) > _BEYOND * most) | (speed < -_LEAVES * most))
    changes = np.abs(np.diff(speed[np.isfinite(speed) & ~bad]))
    if not len(changes):
        return bad
    least = max(_LEAVES * most, _USUAL * float(np.quantile(changes, 0.9)))
    for _ in range(2):  # a glitch beside another one shows once that is known
        held = np.flatnonzero(np.diff(speed, prepend=np.nan, append=np.nan) != 0)
        good = np.where(bad, np.nan, speed)
        for a, b in pairwise(held.tolist()):
            if b - a > _LONGEST or bad[a]:
                continue
            before, behind = good[max(0, a - _AROUND) : a], good[b : b + _AROUND]
            before, behind = before[np.isfinite(before)], behind[np.isfinite(behind)]
            if not len(before) or not len(behind):
                continue
            low, high = min(before[-1], behind[0]), max(before[-1], behind[0])
            if speed[a] < low - least or speed[a] > high + least:
                bad[a:b] = True
        if bad.sum() > _MOST_ROTOR * n:
            break
    return bad


def check_interpolated(system: SystemInfo, raw: Sequence[RawRun], dt: float, report: Report) -> None:
    """Report states that are straight between every few rows, of runs as they were read, about `dt` [s] apart."""
    if any(note.kind == "slow_topic" for run in raw for note in run.notes):
        return  # the reader brought topics onto one clock, and says so
    found = {}
    turning = {position for position, _, _ in system.position_derivatives}
    for k, (name, unit) in enumerate(zip(system.state_names, system.state_units, strict=True)):
        columns = [run.x[:, k] for run in raw]
        angle = unit == "rad" and name in turning
        steps = _rows_between_knots([_unwrapped(x) for x in columns] if angle else columns, columns)
        if steps:
            found[name] = steps
    if not found:
        return
    every = float(np.median(list(found.values())))
    text = (
        f"{', '.join(found)} are straight lines between about every {every:.3g} rows: they were measured at about "
        f"{1.0 / (every * dt):.3g} Hz and interpolated. Their noise is not that of a sensor, and intervals are too "
        f"narrow: write the rows that were measured (one rate for all columns), or set data.dt={every * dt:.3g}"
    )
    values = {"states": list(found), "rows": every}
    report(Finding("interpolated_states", "", len(found), text, "reported", values))


def _unwrapped(angle: Array) -> Array:
    """An angle without its wraps, whose kinks would be its sharpest by far; holes stay."""
    out, known = angle.copy(), np.isfinite(angle)
    out[known] = np.unwrap(angle[known])
    return out


def _rows_between_knots(parts: Sequence[Array], logged: Sequence[Array]) -> float:
    """Rows between the knots of a column, angles without wraps; 0 where it is no chain of straight lines."""
    curved = [np.abs(np.diff(x, 2)) for x in parts if len(x) > 4]
    moves = [np.abs(np.diff(x))[1:] for x in parts if len(x) > 4]
    if not curved:
        return 0.0
    curve, move, whole = (np.concatenate(parts) for parts in (curved, moves, logged))
    steps = np.zeros_like(whole)  # that the values come in; those of missing values count for nothing
    steps[np.isfinite(whole)] = grains(whole[np.isfinite(whole)])
    ends = np.cumsum([len(x) for x in logged])[:-1]
    grain = np.concatenate([g[1:-1] for g in np.split(steps, ends) if len(g) > 4])
    known = np.isfinite(curve)  # beside a missing value nothing is known
    curve, move, grain = curve[known], move[known], grain[known]
    if len(curve) < _FEWEST:
        return 0.0
    large, far = float(np.quantile(curve, 0.95)), float(np.quantile(move, 0.5))
    size = max(float(np.abs(x[np.isfinite(x)]).max(initial=0.0)) for x in logged)
    if not far > 0 or not large > _ROUNDING * size or not float((curve > _QUANTA * grain).mean()) > 0.05:
        return 0.0  # a coarse column is straight between its steps
    nothing = np.maximum(_NOTHING * large, np.minimum(_ROUNDED * grain, _MOST_ROUNDED * large))
    moving = move > _MOVES * far
    share = float((curve[moving] < nothing[moving]).mean())
    return 1.0 / (1.0 - share) if _SHARE[0] < share < _SHARE[1] else 0.0
