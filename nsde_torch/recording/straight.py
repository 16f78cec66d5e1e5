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
from nsde_torch.recording.scatter import quantum

Array = NDArray[np.float64]

_FEWEST = 200
_NOTHING = 0.02
"""Second differences, over the large ones, that count as none; half of those of white noise are above 0.3."""
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
    for k, name in enumerate(system.state_names):
        steps = _every([run.x[:, k] for run in raw])
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


def _every(parts: Sequence[Array]) -> float:
    """Rows between the knots of a column; 0 where it is no chain of straight lines."""
    bends = [np.abs(np.diff(x, 2)) for x in parts if len(x) > 4]
    moves = [np.abs(np.diff(x))[1:] for x in parts if len(x) > 4]
    if not bends:
        return 0.0
    bend, move = np.concatenate(bends), np.concatenate(moves)
    known = np.isfinite(bend)  # beside a missing value nothing is known
    bend, move = bend[known], move[known]
    if len(bend) < _FEWEST:
        return 0.0
    large, far = float(np.quantile(bend, 0.95)), float(np.quantile(move, 0.5))
    whole = np.concatenate([x[np.isfinite(x)] for x in parts])
    if not far > 0 or not large > max(_QUANTA * quantum(whole), _ROUNDING * float(np.abs(whole).max())):
        return 0.0  # a coarse column is straight between its steps
    moving = move > _MOVES * far
    share = float((bend[moving] < _NOTHING * large).mean())
    return 1.0 / (1.0 - share) if _SHARE[0] < share < _SHARE[1] else 0.0
