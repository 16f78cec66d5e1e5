"""The state estimate of the simulated autopilot: the truth with noise, and with the errors that PX4's estimator has.

    heading:    q_believed = R_z(e) q until it climbs past 1.5 m above the ground, then e = 0;    1 deg <= |e| <= 9 deg

    touch-down at v_z = -s:    v_z estimated too low by d, p_z by h;    d' = -d / 1.5 s, d(0) = 0.8 s, h' = d - h / 3 s

PX4 resets its heading there, once in each flight, and ODOMETRY's reset counter grows by one. While the heading is wrong
accelerations are turned by it, and its velocity innovations show that (ESTIMATOR_STATUS):

    ratio = |s|^2 / (5 * 0.3 m/s)^2,      s' = (R_z(e) - 1) v' - s / 0.5 s      (EKF2_GPS_V_GATE, EKF2_GPS_V_NOISE)

What its accelerometer
cannot show of a touch-down it does not know: one at 0.7 m/s takes it half a metre below the ground for seconds, and
`landed` comes only when the estimate no longer sinks.
"""

import random
from cmath import rect
from dataclasses import dataclass, field
from math import cos, radians, sin
from typing import final

from nsde_torch.px4.link.vectors import Quat, Vec, from_rotation_vector, multiply, plus
from nsde_torch.px4.options import SensorErrors
from nsde_torch.px4.simulator.body import Body

ALIGNED = 1.5  # height above ground at which the heading is reset [m]
HEADING = (radians(1.0), radians(9.0))
"""Smallest and largest error of the heading before that, as they were seen [rad]."""
KEPT, SINKS, RISES = 0.8, 1.5, 3.0
"""Share of the touch-down speed that the estimate keeps, and times in which velocity [s] and height [s] come back."""
GATE, CORRECTED = 5.0 * 0.3, 0.5
"""Velocity that is rejected [m/s], and time in which measured velocities correct its own [s]."""
STILL = 0.25  # vertical speed below which it counts as landed [m/s]
Estimate = tuple[Vec, Vec, Quat, Vec]  # position, velocity, attitude and rates


@final
@dataclass(eq=False, kw_only=True)
class SimulatedEstimator:
    """The estimator of one vehicle."""

    std: tuple[float, ...]  # noise of position, velocity, attitude and rates
    seed: int
    heading: float | None = None  # error of it until it is reset [rad]; None: another one in each flight
    errors: SensorErrors = field(default_factory=SensorErrors)  # the slow one of the position is this one's

    def __post_init__(self) -> None:
        self.aligns = True  # whether the heading is reset; versions of 2026 were not seen to
        # innovation ratio of the position, as where its sensors do not share an error
        self.contradicted = 0.02
        self.offset: Vec = (0.0, 0.0, 0.0)  # error of the position that its sensors share, ENU [m]
        self._slow_v: Vec = (0.0, 0.0, 0.0)
        self._slow_p: Vec = (0.0, 0.0, 0.0)
        self._before: Vec = (0.0, 0.0, 0.0)
        self._astray = 0j  # velocity that accelerations along a wrong heading made, east and north
        self._random, self._headings = random.Random(self.seed), random.Random(self.seed + 1)
        self.resets = 0  # how often it was reset; ODOMETRY sends it, to 255
        self.stepped = 0.0  # heading that the last reset turned it by [rad]
        self._error = self._drawn()
        self._speed, self._in_air = 0.0, False
        self._sinking, self._sunk = 0.0, 0.0

    @property
    def still(self) -> bool:
        """Whether the estimate does not sink."""
        return self._sinking < STILL

    def _drawn(self) -> float:
        if self.heading is not None:
            return self.heading
        return self._headings.choice((-1.0, 1.0)) * self._headings.uniform(*HEADING)

    def new_flight(self) -> None:
        """It was disarmed: the heading is no longer trusted."""
        self._error = self._drawn()

    def sense(self, body: Body) -> Estimate:
        """The estimate of the machine as it is now."""
        gauss = self._random.gauss
        sp, sv, sq, sw = self.std

        def noisy(v: Vec, s: float) -> Vec:
            return (v[0] + gauss(0.0, s), v[1] + gauss(0.0, s), v[2] + gauss(0.0, s))

        turn = from_rotation_vector((gauss(0.0, sq), gauss(0.0, sq), gauss(0.0, sq)))
        self.stepped = 0.0
        if self.aligns and self._error != 0.0 and body.p[2] > ALIGNED:
            self.resets, self.stepped, self._error = self.resets + 1, -self._error, 0.0
        q = multiply(body.q, turn)
        if self._error != 0.0:
            q = multiply((cos(0.5 * self._error), 0.0, 0.0, sin(0.5 * self._error)), q)
        self._touch_down(body)
        self._go_astray(body)
        self._drift(body.dt)
        x, y, z = plus(plus(noisy(body.p, sp), self._slow_p), self.offset)
        vx, vy, vz = plus(noisy(body.v, sv), self._slow_v)
        return (x, y, z - self._sunk), (vx, vy, vz - self._sinking), q, noisy(body.w, sw)

    @property
    def velocity_ratio(self) -> float:
        """Innovation ratio of the velocity."""
        return abs(self._astray / GATE) ** 2

    def _go_astray(self, body: Body) -> None:
        gained = complex(body.v[0] - self._before[0], body.v[1] - self._before[1])
        self._before = body.v
        self._astray += (rect(1.0, self._error) - 1.0) * gained - self._astray * body.dt / CORRECTED

    def _drift(self, dt: float) -> None:
        """The slow error of position and velocity a step later."""
        north, east, down = self.errors.estimate
        if not north + east + down:
            return
        time, gauss = self.errors.estimate_time, self._random.gauss
        keep = dt / time
        x, y, z = (gauss(0.0, 2.0 * s / time * keep**0.5) for s in (east, north, down))
        self._slow_p = plus(plus(self._slow_p, self._slow_v, dt), self._slow_p, -keep)
        self._slow_v = plus(plus(self._slow_v, self._slow_v, -keep), (x, y, z))

    def _touch_down(self, body: Body) -> None:
        if self._in_air and body.on_ground:
            self._sinking += KEPT * max(-self._speed, 0.0)
        self._in_air, self._speed = not body.on_ground, body.v[2]
        if self._sinking or self._sunk:
            self._sunk += body.dt * (self._sinking - self._sunk / RISES)
            self._sinking *= 1.0 - body.dt / SINKS
