"""A cascade of proportional loops in plain floats, from a wanted point to body rates and thrust.

    a_sp = a + kv (v + kp (p - p_now) - v_now) + integral,      z_body along a_sp + g, heading as wanted
    w_sp = ka * rotation vector from q to q_sp + w_ref,         thrust = (a_sp + g) . z_body of now

(Structure of PX4's multicopter controllers, docs.px4.io, "Controller diagrams".) It takes some microseconds, needs no
model and no torch, and is what holds the vehicle where any other controller has failed.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, radians, sin, sqrt, tan
from typing import final

from nsde_torch.px4.flight.controller import Demand
from nsde_torch.px4.link.vectors import Quat, Vec, conjugate, length, multiply, rotate, rotation_vector

GRAVITY = 9.81


@dataclass(frozen=True)
class CascadeGains:
    """Gains, in 1/s; horizontal and vertical, or roll and pitch, and yaw.

    Args:
        position: Velocity per position error.
        velocity: Acceleration per velocity error.
        integral: Growth of the integral per velocity error [1/s2].
        attitude: Rate per attitude error.
        speed: Largest speed that position errors ask for [m/s].
        tilt: Largest tilt [rad].
        integral_limit: Largest integral [m/s2].
    """

    position: tuple[float, float] = (1.3, 1.5)
    velocity: tuple[float, float] = (2.6, 3.5)
    integral: tuple[float, float] = (0.5, 1.0)
    attitude: tuple[float, float] = (7.0, 2.5)
    speed: tuple[float, float] = (3.0, 1.5)
    tilt: float = radians(40.0)
    integral_limit: float = 3.0


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
    """The loops, with their integral.

    Args:
        gains: Gains.
    """

    def __init__(self, gains: CascadeGains | None = None) -> None:
        self.gains = gains or CascadeGains()
        self._sum: Vec = (0.0, 0.0, 0.0)

    def reset(self) -> None:
        """Empty the integral."""
        self._sum = (0.0, 0.0, 0.0)

    def __call__(self, p: Vec, v: Vec, q: Quat, to: Point, dt: float) -> Demand:
        """Demand at one sample.

        Args:
            p: Position [m].
            v: Velocity [m/s].
            q: Attitude.
            to: Where to be.
            dt: Time since the last sample [s].
        """
        g = self.gains
        sp = self._velocity(p, to)
        ex, ey, ez = sp[0] - v[0], sp[1] - v[1], sp[2] - v[2]
        lim = g.integral_limit
        sx, sy, sz = self._sum
        self._sum = (
            min(max(sx + g.integral[0] * dt * ex, -lim), lim),
            min(max(sy + g.integral[0] * dt * ey, -lim), lim),
            min(max(sz + g.integral[1] * dt * ez, -lim), lim),
        )
        fx = to.a[0] + g.velocity[0] * ex + self._sum[0]
        fy = to.a[1] + g.velocity[0] * ey + self._sum[1]
        fz = max(to.a[2] + g.velocity[1] * ez + self._sum[2] + GRAVITY, 0.3 * GRAVITY)
        side, most = sqrt(fx * fx + fy * fy), fz * tan(g.tilt)
        if side > most:
            fx, fy = fx * most / side, fy * most / side
        force: Vec = (fx, fy, fz)
        wanted = attitude_along(force, to.yaw)
        r = rotation_vector(multiply(conjugate(q), wanted))
        up = rotate(q, (0.0, 0.0, 1.0))
        return Demand(
            (g.attitude[0] * r[0], g.attitude[0] * r[1], g.attitude[1] * r[2] + to.yaw_rate),
            max(fx * up[0] + fy * up[1] + fz * up[2], 0.0),
        )

    def _velocity(self, p: Vec, to: Point) -> Vec:
        """Velocity that is asked for, position errors limited in the speed they cause."""
        g = self.gains
        dx, dy = g.position[0] * (to.p[0] - p[0]), g.position[0] * (to.p[1] - p[1])
        dz = min(max(g.position[1] * (to.p[2] - p[2]), -g.speed[1]), g.speed[1])
        size = sqrt(dx * dx + dy * dy)
        if size > g.speed[0]:
            dx, dy = dx * g.speed[0] / size, dy * g.speed[0] / size
        return (to.v[0] + dx, to.v[1] + dy, to.v[2] + dz)


def attitude_along(force: Vec, yaw: float) -> Quat:
    """Attitude with the body's z axis along a force: the shortest turn from up, after the turn to the heading."""
    n = length(force)
    zx, zy, zz = force[0] / n, force[1] / n, force[2] / n
    c = sqrt(max(0.5 * (1.0 + zz), 1e-6))
    tilt: Quat = (c, -0.5 * zy / c, 0.5 * zx / c, 0.0)
    return multiply(tilt, (cos(0.5 * yaw), 0.0, 0.0, sin(0.5 * yaw)))


def levelling(q: Quat, gain: float = 4.0) -> Vec:
    """Body rates that level an attitude, heading left alone."""
    up = (2 * (q[1] * q[3] - q[0] * q[2]), 2 * (q[2] * q[3] + q[0] * q[1]))
    cosine = 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2])
    size = sqrt(up[0] * up[0] + up[1] * up[1])
    k = gain * (atan2(size, cosine) / size if size > 1e-6 else 1.0)
    # world's up in body axes (ux, uy): turn body z towards it, axis z x up
    return (-k * up[1], k * up[0], 0.0)
