"""Time on the ground in the log of a multirotor: it stands still on commands that could not carry it.

    mean command  <  0.6 of its median in motion,  |mean v| < 0.15 m/s and |mean omega| < 0.15 rad/s over 0.3 s,
    for half a second and longer

In the air half of the thrust is a fall that gains 2.5 m/s in that time, so that nothing flies like this, and a hover,
however still, has the commands of flight. The ground's force is no part of any model: such rows are cut out, with those
next to them in which it still stands as the commands rise or sink, and with those in which it leaves the ground or
comes down on it and bounces: the last row within 3 s that is less than 5 cm above where it stands, and all before it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from nsde_torch.data.findings import Finding, Report
from nsde_torch.data.raw import RawRun, holes
from nsde_torch.data.system_info import SystemInfo, rate_columns
from nsde_torch.errors import DataError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LOW = 0.6
"""Share of the commands of flight below which nothing flies."""
_STILL, _WINDOW_S, _FEWEST_S = 0.15, 0.3, 0.5
_MOVES, _FEWEST = 0.3, 100  # speed of flight [m/s], and rows of it
_NEARLY, _LONGEST_S = 0.95, 3.0  # commands, and time, in which it may stand while they rise
_SHORT_S = 0.05
CLEAR = 0.05
"""Height above where it stands, up to which a machine that has just stood, or is about to, may touch the ground [m]."""
_BOUNCE_S = 3.0  # longest time of touching down


def commands_in_motion(runs: Sequence[RawRun], system: SystemInfo) -> float | None:
    """Median of the mean command while a multirotor moves; None of another machine, or where it hardly moves.

    Args:
        runs: The runs as read.
        system: Names of the columns.
    """
    v = _velocity(system)
    if v is None:
        return None
    parts = [run.u.mean(axis=1)[np.linalg.norm(run.x[:, v], axis=1) > _MOVES] for run in runs]
    commands = np.concatenate(parts)
    commands = commands[np.isfinite(commands)]
    return float(np.median(commands)) if len(commands) >= _FEWEST else None


def cut(run: RawRun, system: SystemInfo, commands: float, report: Report) -> None:
    """Drops rows in which a multirotor stands on the ground.

    Args:
        run: Without missing values; rows are dropped from it.
        system: Names of the columns.
        commands: Mean command in motion.
        report: Takes the finding.

    Raises:
        DataError: it stands there throughout.
    """
    rows = _touching(run, system, _grounded(run, system, commands))
    if not rows.any():
        return
    where = f"{run.source or 'run'} {run.name!r}"
    if len(run.t) - rows.sum() < 2:
        raise DataError(f"{where}: the machine stands on the ground throughout. Leave the run out.")
    share = float(run.u[rows].mean()) / commands
    parts = holes(rows)
    seconds = sum(float(run.t[b - 1] - run.t[a]) for a, b in parts)
    told = ", ".join(f"t = {run.t[a]:.6g} to {run.t[b - 1]:.6g} s" for a, b in parts[:3])
    report(
        Finding(
            "on_ground",
            run.name,
            int(rows.sum()),
            f"{seconds:.3g} s on the ground ({told}{', ...' if len(parts) > 3 else ''}): it stands there, leaves it or "
            f"comes down on it, on {share:.0%} of the commands of flight",
            "dropped",
            {"seconds": seconds, "rows": parts[:100]},
        )
    )
    run.rows(~rows)


def _velocity(system: SystemInfo) -> list[int] | None:
    names = list(system.state_names)
    motors = bool(system.input_names) and all(n.startswith("u_") for n in system.input_names)
    if not motors or rate_columns(system) is None or not {"v_x", "v_y", "v_z"} <= set(names):
        return None  # what floats or rolls may well stand still on nothing
    return [names.index(n) for n in ("v_x", "v_y", "v_z")]


def _grounded(run: RawRun, system: SystemInfo, commands: float) -> Mask:
    v, rates = _velocity(system), rate_columns(system)
    assert v is not None
    assert rates is not None
    step = float(np.median(np.diff(run.t)))
    moved, turned = run.x[:, v], run.x[:, rates]
    mean = run.u.mean(axis=1)
    low = (mean < LOW * commands) & _still(moved, turned, _WINDOW_S / step)
    stands = (mean < _NEARLY * commands) & _still(moved, turned, _SHORT_S / step)
    out = np.zeros(len(run.t), dtype=bool)
    most = round(_LONGEST_S / step)
    for a, b in holes(low):
        if run.t[b - 1] - run.t[a] < _FEWEST_S:
            continue
        before, behind = stands[max(0, a - most) : a][::-1], stands[b : b + most]
        out[a - _run_in(before) : b + _run_in(behind)] = True
    return out


def _touching(run: RawRun, system: SystemInfo, stands: Mask) -> Mask:
    """Rows in which it stands, with those next to them in which it leaves the ground or bounces on it."""
    if "p_z" not in system.state_names:
        return stands
    height, out = run.x[:, list(system.state_names).index("p_z")], stands.copy()
    most = round(_BOUNCE_S / float(np.median(np.diff(run.t))))
    for a, b in holes(stands):
        near = np.flatnonzero(height < np.median(height[a:b]) + CLEAR)
        near = near[(near >= a - most) & (near < b + most)]
        out[near.min(initial=a) : near.max(initial=b - 1) + 1] = True
    return out


def _still(moved: Array, turned: Array, rows: float) -> Mask:
    size = max(1, round(rows))
    speeds = [np.linalg.norm(uniform_filter1d(c, size, axis=0), axis=1) for c in (moved, turned)]
    return np.asarray((speeds[0] < _STILL) & (speeds[1] < _STILL))


def _run_in(rows: Mask) -> int:
    """How many rows are True before the first that is not."""
    return len(rows) if rows.all() else int(np.argmin(rows))
