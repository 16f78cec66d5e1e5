"""Paths through points by minimum snap: of all paths through the points at their times, that of least integral of the
squared fourth derivative.

It is the spline of degree 7 with six continuous derivatives through the points (de Boor, A Practical Guide to Splines,
chapter V), here at rest up to the third derivative at both ends (Mellinger and Kumar, ICRA 2011). Times that are not
given follow from distances and are stretched until speed and acceleration keep their limits: t -> s t divides speeds by
s and accelerations by s^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import radians, sqrt, tan
from pathlib import Path

import numpy as np
from scipy.interpolate import make_interp_spline

from nsde_torch.arrays import Array
from nsde_torch.control.options import WaypointOptions
from nsde_torch.control.reference import FlightPath
from nsde_torch.control.shapes import GRID
from nsde_torch.data.csv_rows import csv_rows
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.systems.multirotor import GRAVITY

_REST = [(order, np.zeros(4)) for order in (1, 2, 3)]

_LIMITS = WaypointOptions()


def waypoints(
    points: Sequence[Sequence[float]],
    *,
    times: Sequence[float] | None = None,
    speed: float = _LIMITS.speed,
    tilt: float = _LIMITS.tilt,
    name: str = "waypoints",
) -> FlightPath:
    """A path through points.

    Args:
        points: Positions and headings, rows of 3 or 4 numbers [m, m, m, deg]; without a heading it is 0. Headings turn
            as their numbers say: from 170 to 190 is a turn of 20 deg.
        times: When to be there [s], increasing from 0; None: as fast as the limits allow.
        speed: Largest speed where times are not given [m/s].
        tilt: Largest tilt where times are not given [deg].
        name: What it is called.

    Raises:
        ConfigError: fewer than two points, rows of other lengths, points on top of each other, or times that do not
            increase.

    Example:
        >>> waypoints([[0, 0, 1], [2, 0, 1, 90], [2, 2, 1.5, 90]], speed=1.5).p[-1].round(3).tolist()
        [2.0, 2.0, 1.5]
    """
    rows = [list(map(float, row)) for row in points]
    if len(rows) < 2 or not all(len(row) in (3, 4) for row in rows):
        raise ConfigError(
            f"reference {name!r}: `points` takes two or more rows [x, y, z] or [x, y, z, yaw]; got {points!r}."
        )
    table = np.array([row if len(row) == 4 else [*row, 0.0] for row in rows])
    if not np.isfinite(table).all():
        raise ConfigError(f"reference {name!r}: `points` must be finite; got {points!r}.")
    table[:, 3] = np.deg2rad(table[:, 3])
    if times is not None:
        return _through(table, _checked(times, len(table), name), name)
    if not (speed > 0 and 0 < tilt < 80):
        raise ConfigError(
            f"reference {name!r}: `speed` must be above 0 m/s and `tilt` between 0 and 80 deg; got {speed!r}, {tilt!r}."
        )
    far = np.linalg.norm(np.diff(table[:, :3], axis=0), axis=1)
    turned = np.abs(np.diff(table[:, 3]))
    if ((far < 1e-6) & (turned < 1e-6)).any():
        raise ConfigError(
            f"reference {name!r}: points {int(far.argmin())} and {int(far.argmin()) + 1} are the same. Leave one out."
        )
    most = GRAVITY * tan(radians(tilt))
    # legs of a few meters are all acceleration: half of it forward, half of it back
    legs = np.maximum(np.maximum(far / speed, 2.0 * np.sqrt(far / most)), np.maximum(turned, 0.3))
    path = _through(table, np.concatenate(([0.0], np.cumsum(legs))), name)
    fast = np.linalg.norm(path.v, axis=1).max() / speed
    hard = np.linalg.norm(path.a, axis=1).max() / most
    stretch = max(fast, sqrt(hard))
    return _through(table, np.concatenate(([0.0], np.cumsum(legs))) * stretch, name)


def from_csv(file: str | Path, *, speed: float = _LIMITS.speed, tilt: float = _LIMITS.tilt) -> FlightPath:
    """A path through the rows of a CSV file: `p_x p_y p_z` [m], and if there are `yaw` [rad] and `t` [s].

    Raises:
        DataError: the file or a column is missing, or a number is none.
        ConfigError: the rows make no path.
    """
    path = Path(file)
    rows = csv_rows(path, ("p_x", "p_y", "p_z"), what="reference", remedy="Name a CSV file.")
    try:
        points = [
            [*(float(row[n]) for n in ("p_x", "p_y", "p_z")), float(np.rad2deg(float(row.get("yaw") or 0.0)))]
            for row in rows
        ]
        times = [float(row["t"]) for row in rows] if "t" in rows[0] else None
    except (TypeError, ValueError) as error:
        raise DataError(f"reference {path} holds something that is no number ({error}).") from error
    start = times[0] if times else 0.0
    shifted = None if times is None else [t - start for t in times]
    return waypoints(points, times=shifted, speed=speed, tilt=tilt, name=path.stem)


def _checked(times: Sequence[float], n: int, name: str) -> Array:
    t = np.asarray(times, dtype=np.float64)
    if len(t) != n or not np.isfinite(t).all() or t[0] != 0 or (np.diff(t) <= 0).any():
        raise ConfigError(
            f"reference {name!r}: `times` must be {n} times that increase from 0 s; got {list(times)[:8]}."
        )
    return t


def _through(table: Array, times: Array, name: str) -> FlightPath:
    spline = make_interp_spline(times, table, k=7, bc_type=(_REST, _REST))
    n = int(np.floor(times[-1] / GRID + 1e-9)) + 1
    t = np.minimum(GRID * np.arange(n + 1), times[-1])  # the last row stands at the last point
    p, v, a = spline(t), spline(t, 1), spline(t, 2)
    about: dict[str, object] = {"points": table.tolist(), "times": times.tolist()}
    return FlightPath(name, GRID, p[:, :3], v[:, :3], a[:, :3], p[:, 3], about)
