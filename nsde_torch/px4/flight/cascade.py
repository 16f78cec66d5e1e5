"""A cascade of proportional loops in plain floats, from a wanted point to body rates and thrust.

    a_sp = a + kv (v + kp (p - p_now) - v_now) + integral,      z_body along a_sp + g, heading as wanted
    w_sp = ka * rotation vector from q to q_sp + w_ref,         thrust = (a_sp + g) . z_body of now

(Structure of PX4's multicopter controllers, docs.px4.io, "Controller diagrams".) It takes some microseconds, needs no
model and no torch, and is what holds the vehicle where any other controller has failed.
"""

from dataclasses import KW_ONLY, dataclass
from math import atan2, cos, radians, sin, sqrt, tan
from typing import final

import numpy as np

from nsde_torch.control.reference import FlightPath
from nsde_torch.px4.flight.controller import Asked, Demand, DemandPlan
from nsde_torch.px4.link.vectors import (
    Quat,
    Vec,
    bounded,
    conjugate,
    length,
    multiply,
    parts,
    plus,
    rotate,
    rotation_vector,
)

GRAVITY = 9.81
KP, KV, KI, KA = (1.3, 1.5), (2.6, 3.5), (0.5, 1.0), (7.0, 2.5)
"""Velocity per position error, acceleration per velocity error, rate per attitude error [1/s], and growth of the
integral per velocity error [1/s2]; horizontal and vertical, or roll and pitch, and yaw."""
SPEED, TILT, INTEGRAL = (3.0, 1.5), radians(40.0), 3.0
"""Largest speed that position errors ask for, horizontal and vertical [m/s], tilt [rad] and integral [m/s2]."""


@dataclass(frozen=True)
class Point:
    """Where to be: position [m], velocity [m/s], acceleration [m/s2], heading [rad] and its rate [rad/s]."""

    p: Vec
    v: Vec = (0.0, 0.0, 0.0)
    a: Vec = (0.0, 0.0, 0.0)
    yaw: float = 0.0
    yaw_rate: float = 0.0


@final
class SetpointCascade:
    """The loops, with their integral."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self._sum: Vec = (0.0, 0.0, 0.0)

    def __call__(self, p: Vec, v: Vec, q: Quat, to: Point, dt: float) -> Demand:
        """Demand at a position [m], velocity [m/s] and attitude, `dt` after the last sample [s]."""
        ex, ey, ez = plus(_velocity(p, to), v, -1.0)
        self._sum = bounded(plus(self._sum, (KI[0] * dt * ex, KI[0] * dt * ey, KI[1] * dt * ez)), INTEGRAL)
        fx = to.a[0] + KV[0] * ex + self._sum[0]
        fy = to.a[1] + KV[0] * ey + self._sum[1]
        fz = max(to.a[2] + KV[1] * ez + self._sum[2] + GRAVITY, 0.3 * GRAVITY)
        side, most = sqrt(fx * fx + fy * fy), fz * tan(TILT)
        if side > most:
            fx, fy = fx * most / side, fy * most / side
        force: Vec = (fx, fy, fz)
        wanted = attitude_along(force, to.yaw)
        r = rotation_vector(multiply(conjugate(q), wanted))
        up = rotate(q, (0.0, 0.0, 1.0))
        return Demand(
            (KA[0] * r[0], KA[0] * r[1], KA[1] * r[2] + to.yaw_rate),
            max(fx * up[0] + fy * up[1] + fz * up[2], 0.0),
        )


def _velocity(p: Vec, to: Point) -> Vec:
    """Velocity that is asked for, position errors limited in the speed they cause."""
    dx, dy = KP[0] * (to.p[0] - p[0]), KP[0] * (to.p[1] - p[1])
    dz = min(max(KP[1] * (to.p[2] - p[2]), -SPEED[1]), SPEED[1])
    size = sqrt(dx * dx + dy * dy)
    if size > SPEED[0]:
        dx, dy = dx * SPEED[0] / size, dy * SPEED[0] / size
    return plus(to.v, (dx, dy, dz))


def attitude_along(force: Vec, yaw: float) -> Quat:
    """Attitude with the body's z axis along a force: the shortest turn from up, after the turn to the heading."""
    n = length(force)
    zx, zy, zz = force[0] / n, force[1] / n, force[2] / n
    c = sqrt(max(0.5 * (1.0 + zz), 1e-6))
    tilt: Quat = (c, -0.5 * zy / c, 0.5 * zx / c, 0.0)
    return multiply(tilt, (cos(0.5 * yaw), 0.0, 0.0, sin(0.5 * yaw)))


def levelling(q: Quat) -> Vec:
    """Body rates that level an attitude with a gain of 4 1/s, heading left alone."""
    up = (2 * (q[1] * q[3] - q[0] * q[2]), 2 * (q[2] * q[3] + q[0] * q[1]))
    cosine = 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2])
    size = sqrt(up[0] * up[0] + up[1] * up[1])
    k = 4.0 * (atan2(size, cosine) / size if size > 1e-6 else 1.0)
    # world's up in body axes (ux, uy): turn body z towards it, axis z x up
    return (-k * up[1], k * up[0], 0.0)


PAUSE = 0.5  # time without a state after which a flight is a new one [s]
LEAD = 0.1  # how much earlier than needed the cascade asks for accelerations [s]


@final
class PathPoints:
    """Points of a path by time; before its start and after its end at rest."""

    def __init__(self, path: FlightPath) -> None:
        self.name, self.duration, self._dt = path.name, path.duration, path.dt
        yaw_rate = np.gradient(path.yaw, path.dt)
        self._rows = np.column_stack((path.p, path.v, path.a, path.yaw, yaw_rate)).tolist()
        self.speed = float(np.linalg.norm(path.v, axis=1).max())
        self.low: Vec = tuple(path.p.min(0).tolist())
        self.high: Vec = tuple(path.p.max(0).tolist())

    def at(self, t: float) -> Point:
        """The point at a time [s]."""
        s = t / self._dt
        if s <= 0.0 or s >= len(self._rows) - 1:
            row = self._rows[0 if s <= 0.0 else -1]
            return Point((row[0], row[1], row[2]), yaw=row[9])
        k = int(s)
        share = s - k
        r = [a + share * (b - a) for a, b in zip(self._rows[k], self._rows[k + 1], strict=True)]
        return Point((r[0], r[1], r[2]), (r[3], r[4], r[5]), (r[6], r[7], r[8]), r[9], r[10])

    def led(self, t: float, lead: float) -> Point:
        """The point at a time, with the acceleration and heading of a lead later, because attitude follows late [s]."""
        now, soon = self.at(t), self.at(t + lead)
        return Point(now.p, now.v, soon.a, soon.yaw, now.yaw_rate)


@final
@dataclass(eq=False)
class CascadeController:
    """The cascade along a path, as a `FlightController`."""

    path: PathPoints  # points, in the controller's own coordinates
    _: KW_ONLY
    lead: float = LEAD  # see `PathPoints.led` [s]

    def __post_init__(self) -> None:
        self._cascade = SetpointCascade()
        self._last: float | None = None

    def __call__(self, row: tuple[float, ...], time: float, t: float, asked: Asked = ()) -> DemandPlan:
        """See `FlightController`."""
        dt = 0.0 if self._last is None else time - self._last
        if abs(dt) > PAUSE:
            self._cascade.reset()
        dt = min(max(dt, 0.0), 0.05)
        self._last = time
        to = self.path.led(t, self.lead)
        p, v, q, _ = parts(row)
        return DemandPlan(time, 0.05, (self._cascade(p, v, q, to, dt),), "cascade")
