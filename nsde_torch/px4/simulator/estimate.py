"""What the simulated autopilot believes of itself: the truth with noise, and with the errors that PX4's estimator has.

    heading:    q_believed = R_z(e) q until it climbs past 1.5 m above the ground, then e = 0;    1 deg <= |e| <= 9 deg

PX4 resets its heading there, once in each flight, and ODOMETRY's reset counter grows by one.
"""

from __future__ import annotations

import random
from math import cos, radians, sin
from typing import final

from nsde_torch.px4.link.vectors import Quat, Vec, from_rotation_vector, multiply
from nsde_torch.px4.simulator.body import Body

ALIGNED = 1.5
"""Height above ground at which the heading is reset [m]."""
HEADING = (radians(1.0), radians(9.0))
"""Smallest and largest error of the heading before that, as they were seen [rad]."""
Estimate = tuple[Vec, Vec, Quat, Vec]
"""Position, velocity, attitude and rates."""


@final
class SimulatedEstimator:
    """The estimator of one vehicle.

    Args:
        std: Noise of position, velocity, attitude and rates.
        seed: Of the noise, and of the heading's errors.
        heading: Error of the heading until it is reset [rad]; None: another one in each flight.

    Attributes:
        resets: How often it was reset; ODOMETRY sends it, to 255.
        stepped: Heading that the last reset turned it by [rad].
    """

    def __init__(
        self, *, std: tuple[float, float, float, float], seed: int, heading: float | None = None
    ) -> None:
        self._std, self._given = std, heading
        self._random, self._errors = random.Random(seed), random.Random(seed + 1)
        self.resets, self.stepped = 0, 0.0
        self._error = self._drawn()

    def _drawn(self) -> float:
        if self._given is not None:
            return self._given
        return self._errors.choice((-1.0, 1.0)) * self._errors.uniform(*HEADING)

    def new_flight(self) -> None:
        """It was disarmed: the heading is no longer trusted."""
        self._error = self._drawn()

    def sense(self, body: Body) -> Estimate:
        """The estimate of the machine as it is now."""
        gauss = self._random.gauss
        sp, sv, sq, sw = self._std

        def noisy(v: Vec, s: float) -> Vec:
            return (v[0] + gauss(0.0, s), v[1] + gauss(0.0, s), v[2] + gauss(0.0, s))

        turn = from_rotation_vector((gauss(0.0, sq), gauss(0.0, sq), gauss(0.0, sq)))
        self.stepped = 0.0
        if self._error != 0.0 and body.p[2] > ALIGNED:
            self.resets, self.stepped, self._error = self.resets + 1, -self._error, 0.0
        q = multiply(body.q, turn)
        if self._error != 0.0:
            q = multiply((cos(0.5 * self._error), 0.0, 0.0, sin(0.5 * self._error)), q)
        return noisy(body.p, sp), noisy(body.v, sv), q, noisy(body.w, sw)
