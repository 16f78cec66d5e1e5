"""What kinematics and gravity say of the conventions of a log, before any physics of its machine is known.

    log(q(t)^-1 q(t + T)) = int omega dt,    p(t + T) - p(t) = int v dt         (T = 0.25 s)
    a_xy = g M b_xy          a the acceleration, b the body's third axis in the world

A multirotor of any weight accelerates in the direction in which its thrust is tilted. `M` is the identity if the
body's third axis is that of the thrust, its negative if it points down, and another matrix if the axes of positions
are not those of the attitude. Whether the world's third axis is up, too, is seen from the sign of `b_z`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.quaternion import conjugate, increments, rotate

INTERVAL_S = 0.25
SOUND_ATTITUDE, SOUND_VELOCITY = 0.25, 0.05  # shares of the motion that a sound log leaves at most
NOISY_VELOCITY = 5 * SOUND_VELOCITY
"""The share up to which noise explains what velocities leave; an interpretation that leaves more is no remedy."""
_FEWEST = 20  # intervals
_TILT_S = 0.3
_LEAST_TILT = 0.01  # root mean square of the tilt [rad] from which on it says something
_LEFT, _CLEAR = 0.5, 0.6  # share that the right `M` leaves at most, and of that of the next


@dataclass(frozen=True)
class AttitudeWay:
    """A way to read a quaternion and rates: the order of its columns, what it turns, the rates' unit and axes."""

    order: str = "wxyz"
    turns: str = "body to world"
    unit: str = "rad/s"
    signs: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class VelocityWay:
    """A way to read a velocity: along which axes, in what order and with what signs."""

    axes: str
    places: tuple[int, int, int] = (0, 1, 2)
    signs: tuple[float, float, float] = (1.0, 1.0, 1.0)


def read_attitude(q: Array, way: AttitudeWay) -> Array:
    """A quaternion as `w x y z`, body to world."""
    q = q[:, [3, 0, 1, 2]] if way.order == "xyzw" else q
    return conjugate(q) if way.turns == "world to body" else q


def attitude_ways(order: str | None, unit: str | None) -> Iterator[AttitudeWay]:
    """Ways that names leave open, the usual first."""
    for one in (order,) if order else ("wxyz", "xyzw"):
        for turns in ("body to world", "world to body"):
            for rate in (unit,) if unit else ("rad/s", "deg/s"):
                for signs in ((1.0, 1.0, 1.0), (1.0, -1.0, -1.0)):
                    yield AttitudeWay(one, turns, rate, signs)


def velocity_ways() -> Iterator[VelocityWay]:
    """Ways to read a velocity, the usual first."""
    yield VelocityWay("world")
    yield VelocityWay("body")
    yield VelocityWay("body", signs=(1.0, -1.0, -1.0))
    yield VelocityWay("world", signs=(1.0, 1.0, -1.0))
    yield VelocityWay("world", (1, 0, 2), (1.0, 1.0, -1.0))


def attitude_left(t: Array, q: Array, w: Array, way: AttitudeWay) -> float:
    """Share of the turning over 0.25 s that rates leave; nan of too little motion.

    Quaternion (n, 4) and rates (n, 3) are as logged, and read in that way; times (n,) are in seconds.
    """
    size = np.pi / 180.0 if way.unit == "deg/s" else 1.0
    turned = increments(read_attitude(q, way))
    rate = size * w * np.array(way.signs)
    return motion_left(t, turned, 0.5 * (rate[1:] + rate[:-1]))


def velocity_left(t: Array, q: Array | None, p: Array, v: Array, way: VelocityWay) -> float:
    """Share of the movement over 0.25 s that a velocity leaves; nan of too little motion.

    The velocity (n, 3) is as logged, and read in that way; the attitude `w x y z` (n, 4), body to world, is needed for
    one along the body's axes. Times (n,) are in seconds.
    """
    rate = v[:, list(way.places)] * np.array(way.signs)
    if way.axes == "body":
        if q is None:
            return float("nan")
        rate = rotate(q, rate)
    return motion_left(t, np.diff(p, axis=0), 0.5 * (rate[1:] + rate[:-1]))


def noise_share(t: Array, p: Array) -> float:
    """Share of the movement of positions (n, axes) over 0.25 s that is white noise; all, where they rest."""
    length = max(1, round(INTERVAL_S / float(np.median(np.diff(t)))))
    moved = np.diff(p[::length], axis=0)
    noise = 1.4826 * np.nanmedian(np.abs(np.diff(p, 5, axis=0)), axis=0) / 252.0**0.5
    return float(2.0 * np.square(noise).sum() / max(np.nanvar(moved, axis=0).sum(), 1e-300))


def motion_left(t: Array, change: Array, rate: Array) -> float:
    """Share of changes from row to row (n - 1, k), over 0.25 s, that mean rates leave; nan of too little motion."""
    dt = np.diff(t)
    usual = float(np.median(dt))
    length = max(1, round(INTERVAL_S / usual))
    good = np.isfinite(change).all(axis=1) & np.isfinite(rate).all(axis=1) & (dt < 2.5 * usual)
    n = len(dt) // length
    if n < _FEWEST:
        return float("nan")
    whole = good[: n * length].reshape(n, length).all(axis=1)
    if whole.sum() < _FEWEST:
        return float("nan")
    parts = (np.where(good[:, None], values, 0.0)[: n * length] for values in (change, rate * dt[:, None]))
    moved, told = (part.reshape(n, length, -1).sum(axis=1)[whole] for part in parts)
    bias = (moved - told).mean(axis=0)
    told = told + bias * (np.abs(bias) < 0.2 * moved.std(axis=0))
    size = float(np.square(moved - moved.mean(axis=0)).sum())
    rounding = 1e-18 * float(np.square(moved).sum())
    return float(np.square(moved - told).sum()) / size if size > rounding else float("nan")


LEANS: dict[str, tuple[tuple[int, int], tuple[int, int]]] = {
    "up": ((1, 0), (0, 1)),
    "down": ((-1, 0), (0, -1)),
    "turned by 90 deg": ((0, -1), (1, 0)),
    "turned by -90 deg": ((0, 1), (-1, 0)),
    "exchanged": ((0, 1), (1, 0)),
    "exchanged and reversed": ((0, -1), (-1, 0)),
    "reversed in x": ((-1, 0), (0, 1)),
    "reversed in y": ((1, 0), (0, -1)),
}
"""What `M` may be: third axes up or down, or horizontal axes of positions that are not those of the attitude."""


@dataclass(frozen=True)
class Lean:
    """How horizontal acceleration follows the tilt of the body's third axis."""

    left: dict[str, float]
    """Share of the horizontal acceleration that each `M` of `LEANS` leaves, its size free."""
    up: float  # mean of the third component of the body's third axis in the world: 1 level, -1 upside down

    @property
    def way(self) -> str | None:
        """Key of `LEANS` that explains most; None where none explains much, or two do."""
        first, second = sorted(self.left, key=lambda name: self.left[name])[:2]
        clear = self.left[first] < _LEFT and self.left[first] < _CLEAR * self.left[second]
        return first if clear else None


def lean(t: Array, q: Array, p: Array) -> Lean | None:
    """`M` of a flight, by least squares on means over 0.3 s; None where there is too little of it.

    Times (n,) are in seconds, attitudes `w x y z` (n, 4) body to world, positions (n, 3).
    """
    good = np.isfinite(q).all(axis=1) & np.isfinite(p).all(axis=1)
    t, q, p = t[good], q[good], p[good]
    if len(t) < 2 or t[-1] - t[0] < 10 * _TILT_S:
        return None
    step = _TILT_S / 4
    if t[-1] - t[0] > 2 * step * len(t):  # too few rows to say anything, or times of no clock
        return None
    grid = np.arange(t[0], t[-1], step)
    third = rotate(q, np.broadcast_to([0.0, 0.0, 1.0], (len(q), 3)))
    edges = np.searchsorted(t, np.append(grid, t[-1]))
    counts = np.diff(edges)
    if (counts == 0).mean() > 0.2:
        return None
    keep = counts > 0
    starts = edges[:-1][keep]
    b = np.add.reduceat(third, starts, axis=0) / counts[keep][:, None]
    x = np.add.reduceat(p, starts, axis=0) / counts[keep][:, None]
    k = 4  # a second difference over twice 0.3 s, and the mean of the tilt with the same triangle
    if len(x) < 4 * k:
        return None
    even = np.diff(np.flatnonzero(keep)) == 1
    a = (x[2 * k :] - 2.0 * x[k:-k] + x[: -2 * k]) / (k * step) ** 2
    triangle = np.concatenate([np.arange(1, k + 1), np.arange(k - 1, 0, -1)]) / k**2
    leaning = np.stack([np.convolve(b[:, j], triangle, mode="valid") for j in range(3)], axis=1)
    leaning = leaning[1 : 1 + len(a)]
    broken = np.convolve(~even, np.ones(2 * k), mode="valid")[: len(a)] > 0
    a, leaning = a[: len(leaning)][~broken[: len(leaning)]], leaning[~broken[: len(leaning)]]
    if len(a) < 40 or float(np.sqrt(np.square(leaning[:, :2]).mean())) < _LEAST_TILT:
        return None
    plane = leaning[:, :2] - leaning[:, :2].mean(axis=0)
    flat = a[:, :2] - a[:, :2].mean(axis=0)
    whole = max(float(np.square(flat).sum()), 1e-300)
    left = {}
    for name, matrix in LEANS.items():
        told = plane @ np.array(matrix, dtype=float).T
        size = max(float((flat * told).sum()) / max(float(np.square(told).sum()), 1e-300), 0.0)
        left[name] = float(np.square(flat - size * told).sum()) / whole
    return Lean(left, float(np.nanmean(third[:, 2])))


def best(values: Sequence[float]) -> int | None:
    """Index of the smallest value; of some within a factor of 1.5 the first. None where all are nan."""
    known = [v for v in values if np.isfinite(v)]
    if not known:
        return None
    least = max(min(known), 1e-9)
    return next(k for k, v in enumerate(values) if np.isfinite(v) and v <= 1.5 * least)
