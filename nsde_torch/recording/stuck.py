"""State columns that never change, though what they are the integral or the rate of does.

A column of one value throughout a run is a sensor that is not connected, or a column that was filled in. Its partner in
the kinematics says which: a smooth motion there contradicts it and is refused, noise alone does not (a machine at rest
before a coarse sensor), and is reported where the column stands still in every run.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data.findings import Finding, Report
from nsde_torch.data.quaternion import increments
from nsde_torch.data.run import Run
from nsde_torch.data.system_info import SystemInfo, derivative_columns, rate_columns
from nsde_torch.errors import DataError

Array = NDArray[np.float64]

_FEWEST = 20
_SMOOTH = 0.7  # steps over spread: 1.4 for white noise, little for a motion


def check(system: SystemInfo, runs: Sequence[Run], report: Report) -> None:
    """Refuses a column that stands still while its partner moves; reports one that stands still in every run.

    Args:
        system: Names, and which columns are derivatives of which.
        runs: The runs.
        report: Takes the findings.

    Raises:
        DataError: a column that contradicts its partner.
    """
    names = list(system.state_names)
    for run in runs:
        for column, other, still, moving in _pairs(system, run):
            if len(moving) >= _FEWEST and _still(still) and _moves(moving):
                raise DataError(
                    f"run {run.name!r}: {column} never changes ({still.flat[0]:.4g} in all {len(still)} rows), while "
                    f"{other} does, so that it is no measurement. Write what the sensor measured, or leave the run out."
                )
    q = system.quaternion
    fixed = [
        k
        for k in range(len(names))
        if not (q is not None and q.start <= k < q.stop)
        and all(_still(run.x[:, k]) and run.x[0, k] == runs[0].x[0, k] for run in runs)
    ]
    if fixed:
        shown = ", ".join(f"{names[k]} = {runs[0].x[0, k]:.4g}" for k in fixed)
        report(
            Finding(
                "constant_state",
                "",
                len(fixed),
                f"states that never change: {shown}; nothing that acts on them, or through them, can be learned. "
                "If they are no measurements, write those; if they stand still, record runs in which they move",
                "reported",
                {"states": [names[k] for k in fixed]},
            )
        )


def _pairs(system: SystemInfo, run: Run) -> Iterator[tuple[str, str, Array, Array]]:
    """Of each position and rate, either way round: both names, the column that may stand still, and its partner."""
    names, x = system.state_names, run.x
    for i, j in derivative_columns(system).values():
        for a, b in zip(i, j, strict=True):
            yield repr(names[a]), repr(names[b]), x[:, a], x[:, b]
            yield repr(names[b]), repr(names[a]), x[:, b], x[:, a]
    rates, q = rate_columns(system), system.quaternion
    if rates is None or q is None:
        return
    turned = np.cumsum(increments(x[:, q]), 0)
    for k, c in enumerate(range(rates.start, rates.stop)):
        yield "the quaternion", repr(names[c]), x[:, q], x[:, c]
        yield repr(names[c]), "the attitude about its axis", x[:, c], turned[:, k]


def _still(column: Array) -> bool:
    return bool((column == column[0]).all())


def _moves(column: Array) -> bool:
    """Whether a column holds a smooth motion, beside a drift at a constant rate."""
    line = np.linspace(-1.0, 1.0, len(column))
    rest = column - column.mean()
    rest = rest - line * float(line @ rest) / float(line @ line)
    spread = float(rest.std())
    return spread > 1e-12 and float(np.diff(rest).std()) < _SMOOTH * spread
