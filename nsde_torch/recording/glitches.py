"""Single samples that leave their neighbours by far and come back: what a transmission or a reflection does.

    d[k] = x[k] - (4 (x[k-1] + x[k+1]) - (x[k-2] + x[k+2])) / 6

is what a cubic through the neighbours leaves of a sample. A glitch exceeds 8 robust standard deviations of its column,
4 times the 90 % quantile of its neighbourhood, and 4 usual changes from row to row (a kink, as where a force changes
its sign, does not); with it taken out its neighbours fit, which rules out a step; and it is no motion: a position
whose rate goes the same way is kept. What was off is put on the cubic.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import percentile_filter

from nsde_torch.data.findings import Finding, Report
from nsde_torch.data.raw import RawRun
from nsde_torch.data.system_info import SystemInfo, derivative_columns
from nsde_torch.recording.scatter import off_curve, quantum

Array = NDArray[np.float64]

SIGMAS, ISOLATION, CHANGES = 8.0, 4.0, 4.0
NEIGHBOURHOOD = 25
"""Rows on each side against which a sample is judged."""
_QUANTA, _SHARE = 3.0, 0.01  # of the steps that values come in, and of their range
_LEFT = 0.3  # share of a glitch that its neighbours may be off without it
_MOST = 0.02  # share of the rows; more is how the sensor is
_EVEN = 0.2


def mend(run: RawRun, system: SystemInfo, report: Report) -> None:
    """Puts single samples that are off by far on the curve through their neighbours.

    Args:
        run: Without missing values and wraps; its states are replaced.
        system: Names, and which columns are derivatives of which.
        report: Takes one finding for each column.
    """
    n = len(run.t)
    if n < 2 * NEIGHBOURHOOD:
        return
    even = _even(run.t)
    partners = dict(_partners(system))
    q = range(n)[:0] if system.quaternion is None else range(run.x.shape[1])[system.quaternion]
    turned = False
    for k, name in enumerate(system.state_names):
        rate = partners.get(k)
        column, rows, sizes = _mended(run.x[:, k], even, None if rate is None else run.x[:, rate], run.t)
        if not rows or len(rows) > _MOST * n:
            continue
        run.x = run.x.copy()
        run.x[:, k] = column
        turned = turned or k in q
        order = np.argsort(rows)
        rows, sizes = [rows[i] for i in order], [sizes[i] for i in order]
        shown = ", ".join(f"{size:+.3g} in row {row}" for row, size in zip(rows[:3], sizes[:3], strict=True))
        report(
            Finding(
                "glitch",
                run.name,
                len(rows),
                f"{len(rows)} single samples of {name!r} off by far ({shown}{', ...' if len(rows) > 3 else ''})",
                "interpolated",
                {"column": name, "rows": rows, "sizes": sizes},
            )
        )
    if turned:
        run.x[:, system.quaternion] /= np.linalg.norm(run.x[:, system.quaternion], axis=1, keepdims=True)


def _partners(system: SystemInfo) -> Iterator[tuple[int, int]]:
    """Columns of positions, and of their rates."""
    for i, j in derivative_columns(system).values():
        yield from zip(i, j, strict=True)


def _even(t: Array) -> NDArray[np.bool_]:
    """Whether the two rows before and behind are about one step apart each."""
    step = np.diff(t)
    good = np.abs(step - np.median(step)) < _EVEN * np.median(step)
    out = np.zeros(len(t), dtype=bool)
    out[2:-2] = good[:-3] & good[1:-2] & good[2:-1] & good[3:]
    return out


def _mended(
    column: Array, even: NDArray[np.bool_], rate: Array | None, t: Array
) -> tuple[Array, list[int], list[float]]:
    """The column without glitches, their rows and sizes."""
    size = np.abs(off_curve(column))
    changes = np.abs(np.diff(column))
    some = changes[changes > 0]
    if not len(some) or not even.any():
        return column, [], []
    least = max(
        SIGMAS * 1.4826 * float(np.median(size[even])),
        CHANGES * float(np.quantile(changes, 0.95)),
        _QUANTA * quantum(column),
        _SHARE * float(np.ptp(column)),
    )
    candidates = np.flatnonzero(even & (size > least))
    if not len(candidates):
        return column, [], []
    usual = percentile_filter(size, 90, size=2 * NEIGHBOURHOOD + 1, mode="nearest")
    candidates = candidates[size[candidates] > ISOLATION * usual[candidates]]
    column, rows, sizes = column.copy(), [], []
    for k in candidates[np.argsort(-size[candidates])].tolist():
        off = float(off_curve(column[k - 2 : k + 3])[2])  # what was mended nearby no longer counts
        if abs(off) <= least:
            continue
        without = column[max(0, k - 4) : k + 5].copy()
        at = k - max(0, k - 4)
        without[at] -= off
        left = np.abs(off_curve(without))
        back = abs(column[k + 1] - column[k - 1])
        if max(left[at - 2 : at + 3].max(), back) > _LEFT * abs(off) + least / SIGMAS * 3:
            continue
        if rate is not None and _moves(column, off, rate, t, k):
            continue
        column[k] -= off
        rows.append(k)
        sizes.append(off)
    return column, rows, sizes


def _moves(position: Array, off: float, rate: Array, t: Array, k: int) -> bool:
    """Whether the rate says that the position went there and back."""
    gap = np.diff(position[k - 1 : k + 2]) - 0.5 * np.diff(t[k - 1 : k + 2]) * (
        rate[k - 1 : k + 1] + rate[k : k + 2]
    )
    mended = gap - np.array([off, -off])
    return float(gap @ gap) < float(mended @ mended)
