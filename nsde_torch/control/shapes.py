"""Flight paths: shapes, and rows of a file.

    circle       p = c + r (cos f, sin f)                 speed r f'
    lemniscate   p = c + (a sin f, b sin f cos f)         speed sqrt(a^2 + b^2) f' where the branches cross

The phase f starts and ends at rest: f' rises as a polynomial of degree 7 whose first three derivatives vanish at both
ends, so that the path has four continuous derivatives. Sizes are chosen such that the largest tilts are those of the
supplement's Figures 17 and 18 (32 deg; for the lemniscate 32 deg of roll and 19 deg of pitch).
"""

from collections.abc import Sequence
from math import radians, sqrt, tan
from pathlib import Path

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.control.options import CircleOptions, HoverOptions, LemniscateOptions, WaypointOptions
from nsde_torch.control.reference import GRID, FlightPath
from nsde_torch.data.csv_folder import csv_rows
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.systems.multirotor import GRAVITY


def _phase(name: str, o: CircleOptions | LemniscateOptions, rate: float) -> Array:
    """f, f', f'' (3, n) on the grid: from rest to `rate` [rad/s], and back to rest, over a ramp each."""
    duration, ramp = o.duration, o.ramp
    if duration < 2.0 * ramp:
        raise ConfigError(
            f"reference {name!r}: `duration`={duration:g} s is shorter than two ramps of {ramp:g} s. Give "
            "more time, or a shorter `ramp`."
        )
    t = GRID * np.arange(round(duration / GRID) + 1)
    s = np.clip(np.minimum(t, t[-1] - t) / ramp, 0.0, 1.0)
    sign = np.where(t < 0.5 * t[-1], 1.0, -1.0)
    rise = s**4 * (35.0 - 84.0 * s + 70.0 * s**2 - 20.0 * s**3)
    slope = 140.0 * s**3 * (1.0 - s) ** 3 * sign / ramp
    # the integral of the rise, in closed form on both ramps
    integral = ramp * s**5 * (7.0 - 14.0 * s + 10.0 * s**2 - 2.5 * s**3)
    until = np.where(t < ramp, integral, 0.5 * ramp + (t - ramp))
    total = t[-1] - ramp
    f = np.where(t > t[-1] - ramp, total - integral, until)
    return np.stack((rate * f, rate * rise, rate * slope))


def circle(**sizes: float) -> FlightPath:
    """A circle at constant speed, while the heading turns once to `yaw` and back, of the sizes of `CircleOptions`.

    ConfigError: a size is out of its range, or the flight is shorter than its two ramps.
    """
    o = CircleOptions(**sizes)
    f, df, ddf = _phase("circle", o, o.speed / o.radius)
    c, s, zero = np.cos(f), np.sin(f), np.zeros_like(f)
    p = np.stack((o.radius * c, o.radius * s, zero + o.height), 1)
    v = np.stack((-o.radius * s * df, o.radius * c * df, zero), 1)
    a = o.radius * np.stack((-c * df**2 - s * ddf, -s * df**2 + c * ddf, zero), 1)
    share = np.linspace(0.0, 1.0, len(f))
    heading = np.deg2rad(o.yaw) * 0.5 * (1.0 - np.cos(2.0 * np.pi * share))
    return FlightPath("circle", GRID, p, v, a, heading, _about(o))


def lemniscate(**sizes: float) -> FlightPath:
    """A figure of eight (Gerono's lemniscate), while the heading oscillates, of the sizes of `LemniscateOptions`.

    ConfigError: a size is out of its range, or the flight is shorter than its two ramps.
    """
    o = LemniscateOptions(**sizes)
    f, df, ddf = _phase("lemniscate", o, o.speed / float(np.hypot(o.length, o.width)))
    c, s, c2, s2, zero = np.cos(f), np.sin(f), np.cos(2 * f), np.sin(2 * f), np.zeros_like(f)
    p = np.stack((o.length * s, 0.5 * o.width * s2, zero + o.height), 1)
    v = np.stack((o.length * c * df, o.width * c2 * df, zero), 1)
    a = np.stack((o.length * (c * ddf - s * df**2), o.width * (c2 * ddf - 2.0 * s2 * df**2), zero), 1)
    heading = np.deg2rad(o.yaw) * np.sin(2.0 * np.pi * np.linspace(0.0, 3.0, len(f)))
    return FlightPath("lemniscate", GRID, p, v, a, heading, _about(o))


def hover(**sizes: float) -> FlightPath:
    """Standing still, of the sizes of `HoverOptions`. ConfigError: a size is out of its range."""
    o = HoverOptions(**sizes)
    n = round(o.duration / GRID) + 1
    zero, heading = np.zeros((n, 3)), np.full(n, np.deg2rad(o.yaw))
    return FlightPath("hover", GRID, zero + np.array([0.0, 0.0, o.height]), zero, zero, heading, _about(o))


def _about(o: CircleOptions | LemniscateOptions | HoverOptions) -> dict[str, object]:
    return {name: value for name, value in vars(o).items() if name not in ("duration", "ramp")}


# Paths through points by minimum snap: of all paths through the points at their times, that of least integral
# of the squared fourth derivative.
#
# It is the spline of degree 7 with six continuous derivatives through the points (de Boor, A Practical Guide
# to Splines, chapter V), here at rest up to the third derivative at both ends (Mellinger and Kumar, ICRA
# 2011). Times that are not given follow from distances and are stretched until speed and acceleration keep
# their limits: t -> s t divides speeds by s and accelerations by s^2.

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
        t = np.asarray(times, dtype=np.float64)
        if len(t) != len(table) or not np.isfinite(t).all() or t[0] != 0 or (np.diff(t) <= 0).any():
            raise ConfigError(
                f"reference {name!r}: `times` must be {len(table)} times that increase from 0 s; got {list(times)[:8]}."
            )
        return _through(table, t, name)
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

    DataError: the file or a column is missing, or a number is none. ConfigError: the rows make no path.
    """
    path = Path(file)
    rows = csv_rows(path, ("p_x", "p_y", "p_z"), what="reference", remedy="Name a CSV file.")
    try:
        points = [
            [*(float(row[n]) for n in ("p_x", "p_y", "p_z")), float(np.rad2deg(float(row.get("yaw") or 0.0)))]
            for row in rows
        ]
        times = [float(row["t"]) - float(rows[0]["t"]) for row in rows] if "t" in rows[0] else None
    except (TypeError, ValueError) as error:
        raise DataError(f"reference {path} holds something that is no number ({error}).") from error
    return waypoints(points, times=times, speed=speed, tilt=tilt, name=path.stem)


def _through(table: Array, times: Array, name: str) -> FlightPath:
    from scipy.interpolate import make_interp_spline  # half a second, which a circle does not need

    spline = make_interp_spline(times, table, k=7, bc_type=(_REST, _REST))
    n = int(np.floor(times[-1] / GRID + 1e-9)) + 1
    t = np.minimum(GRID * np.arange(n + 1), times[-1])  # the last row stands at the last point
    p, v, a = spline(t), spline(t, 1), spline(t, 2)
    about: dict[str, object] = {"points": table.tolist(), "times": times.tolist()}
    return FlightPath(name, GRID, p[:, :3], v[:, :3], a[:, :3], p[:, 3], about)
