"""States that were interpolated: straight lines between rows that were measured.

    x_{k+1} - 2 x_k + x_{k-1} = 0        on every row but the knots

Sensors have noise on every row. Where most second differences of a column are next to nothing beside those of the other
rows, the column was resampled by linear interpolation, and what looks like a rate of the log is not that of the sensor.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data.findings import Finding, Report
from nsde_torch.data.raw import RawRun
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.recording.scatter import grains

Array = NDArray[np.float64]

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


def check(system: SystemInfo, raw: Sequence[RawRun], dt: float, report: Report) -> None:
    """Report states that are straight between every few rows.

    Args:
        system: Names of the states.
        raw: Runs as they were read, rows in order.
        dt: Their step [s].
        report: Takes the findings.
    """
    if any(note.kind == "slow_topic" for run in raw for note in run.notes):
        return  # the reader brought topics onto one clock, and says so
    found = {}
    turning = {position for position, _, _ in system.position_derivatives}
    for k, (name, unit) in enumerate(zip(system.state_names, system.state_units, strict=True)):
        columns = [run.x[:, k] for run in raw]
        angle = unit == "rad" and name in turning
        steps = _every([_unwrapped(x) for x in columns] if angle else columns, columns)
        if steps:
            found[name] = steps
    if not found:
        return
    every = float(np.median(list(found.values())))
    report(
        Finding(
            "interpolated_states",
            "",
            len(found),
            f"{', '.join(found)} are straight lines between about every {every:.3g} rows: they were measured at about "
            f"{1.0 / (every * dt):.3g} Hz and interpolated. Their noise is not that of a sensor, and intervals are too "
            f"narrow: write the rows that were measured (one rate for all columns), or set data.dt={every * dt:.3g}",
            "reported",
            {"states": list(found), "rows": every},
        )
    )


def _unwrapped(angle: Array) -> Array:
    """An angle without its wraps, which would be its largest bends by far; holes stay."""
    out, known = angle.copy(), np.isfinite(angle)
    out[known] = np.unwrap(angle[known])
    return out


def _every(parts: Sequence[Array], logged: Sequence[Array]) -> float:
    """Rows between the knots of a column; 0 where it is no chain of straight lines.

    Args:
        parts: The column in each run, angles without wraps.
        logged: The same as it was logged.
    """
    bends = [np.abs(np.diff(x, 2)) for x in parts if len(x) > 4]
    moves = [np.abs(np.diff(x))[1:] for x in parts if len(x) > 4]
    if not bends:
        return 0.0
    bend, move = np.concatenate(bends), np.concatenate(moves)
    grain = np.concatenate([g[1:-1] for g in _grains(logged) if len(g) > 4])
    known = np.isfinite(bend)  # beside a missing value nothing is known
    bend, move, grain = bend[known], move[known], grain[known]
    if len(bend) < _FEWEST:
        return 0.0
    large, far = float(np.quantile(bend, 0.95)), float(np.quantile(move, 0.5))
    size = max(float(np.abs(x[np.isfinite(x)]).max(initial=0.0)) for x in logged)
    if not far > 0 or not large > _ROUNDING * size or not float((bend > _QUANTA * grain).mean()) > 0.05:
        return 0.0  # a coarse column is straight between its steps
    nothing = np.maximum(_NOTHING * large, np.minimum(_ROUNDED * grain, _MOST_ROUNDED * large))
    moving = move > _MOVES * far
    share = float((bend[moving] < nothing[moving]).mean())
    return 1.0 / (1.0 - share) if _SHARE[0] < share < _SHARE[1] else 0.0


def _grains(parts: Sequence[Array]) -> list[Array]:
    """Steps that the values of a column come in, run by run; those of missing values count for nothing."""
    whole = np.concatenate(parts)
    out, known = np.zeros_like(whole), np.isfinite(whole)
    out[known] = grains(whole[known])
    return np.split(out, np.cumsum([len(part) for part in parts])[:-1])
