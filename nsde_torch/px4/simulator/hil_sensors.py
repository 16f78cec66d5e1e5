"""What sensors on a machine would show, as the messages that PX4 takes from a simulator.

    accelerometer = R' (v' + g z),      gyroscope = w,      magnetometer = R' B,
    p = 1013.25 hPa (1 - 2.25577e-5 h)^5.25588          (International Standard Atmosphere, ISO 2533)

in FRD: at rest the accelerometer shows -g along z. `B` and the place are those of PX4's default home (Zurich; World
Magnetic Model, rounded). The IMU comes with every message, the others more seldom, each with its bits in
`fields_updated` (PX4 takes a sensor only if all of its bits are set).
"""

from __future__ import annotations

import random
from collections import deque
from math import atan2, ceil, cos, degrees, radians, sin
from typing import final

from nsde_torch.px4.flight.cascade import GRAVITY
from nsde_torch.px4.link import frames
from nsde_torch.px4.link.codec import Message
from nsde_torch.px4.link.dialect import mavlink
from nsde_torch.px4.link.vectors import (
    Quat,
    Vec,
    between,
    conjugate,
    length,
    multiply,
    rotate_back,
    rotation_vector,
    turned_by_rates,
)
from nsde_torch.px4.simulator.sensor_errors import SensorErrors

LATITUDE, LONGITUDE, ALTITUDE = 47.397742, 8.545594, 488.0
"""Of the place of take-off [deg, deg, m]."""
_STRENGTH, _DECLINATION, _INCLINATION = 0.483, radians(3.0), radians(63.3)
FIELD_NED: Vec = (
    _STRENGTH * cos(_INCLINATION) * cos(_DECLINATION),
    _STRENGTH * cos(_INCLINATION) * sin(_DECLINATION),
    _STRENGTH * sin(_INCLINATION),
)
"""Magnetic field [gauss]."""
RATE = 250.0
"""Samples of the IMU in a second; it is what PX4 integrates at in simulation."""
ACCELEROMETER, GYROSCOPE, MAGNETOMETER = 0b111, 0b111_000, 0b111_000_000
BAROMETER = 1 << 9 | 1 << 11 | 1 << 12
"""Bits of `fields_updated`: three axes each; absolute pressure, its altitude and the temperature."""
_EVERY = {"mag": (4, 1), "baro": (5, 2), "gps": (25, 3), "truth": (5, 4)}
"""One in so many samples, and which of them, so that they do not all come at once."""
_EARTH = 6_371_000.0
HARDEST = 4.0 * GRAVITY
"""Largest acceleration that is shown [m/s2]: a touch-down within one sample would show more than any sensor does.

What is more than that is shown by the samples after it, as the stop on a real ground lasts: no velocity may get lost.
"""
FASTEST = 10.0
"""Largest rate that is shown of a turn within one sample [rad/s]: the ground levels a machine that comes down tilted.

The samples after it show the rest, and accelerations along the axes as they are shown: PX4 would take a turn that no
gyroscope showed for a wrong attitude, and drift off by what it then sees of gravity.
"""
_STEADY = 1.0
"""Rate that a turn within a sample may miss the machine's own by, which goes on within it [rad/s]."""


def pressure(height: float) -> float:
    """Pressure [hPa] at a height above the sea [m]."""
    return float(1013.25 * (1.0 - 2.25577e-5 * height) ** 5.25588)


@final
class HilSensors:
    """Sensors with errors.

    Args:
        seed: Of the noise.
        noise: Factor on it.
        errors: Noise, biases and delay. A delay other than the one that PX4 expects sets its position and velocity
            apart from its attitude.
    """

    def __init__(self, *, seed: int, noise: float = 1.0, errors: SensorErrors | None = None) -> None:
        self._random, self._noise = random.Random(seed), noise
        self._errors = errors or SensorErrors()
        self._before: Vec = (0.0, 0.0, 0.0)
        self._rest: Vec = (0.0, 0.0, 0.0)
        self._shown: Quat | None = None
        self._count = 0
        self._flown = deque[tuple[Vec, Vec]](maxlen=ceil(self._errors.gps_delay * RATE) + 1)

    def messages(self, time: float, p: Vec, v: Vec, q: Quat, w: Vec) -> list[Message]:
        """What is sent of one state; call it once for each sample.

        Args:
            time: [s]
            p: Position from the place of take-off, ENU [m].
            v: Velocity, ENU [m/s].
            q: Attitude, FLU to ENU.
            w: Body rates, FLU [rad/s].
        """
        k, self._count = self._count, self._count + 1
        a, b = v, self._before
        r = self._rest
        gained = (
            RATE * (a[0] - b[0]) + r[0],
            RATE * (a[1] - b[1]) + r[1],
            RATE * (a[2] - b[2]) + r[2] + GRAVITY,
        )
        share = HARDEST / max(length(gained), HARDEST)
        shown: Vec = (share * gained[0], share * gained[1], share * gained[2])
        self._rest = (gained[0] - shown[0], gained[1] - shown[1], gained[2] - shown[2])
        self._before = v
        rates = self._rates(q, w)
        force = rotate_back(self._shown or q, shown)
        e = self._errors
        acc = self._noisy(frames.body(force), e.accelerometer, e.accelerometer_bias)
        gyro = self._noisy(frames.body(rates), e.gyroscope, e.gyroscope_bias)
        # the field turned into the body: world to NED first, as the attitude is NED's here
        mag = self._noisy(rotate_back(frames.attitude(q), FIELD_NED), e.magnetometer)
        height = ALTITUDE + p[2]
        air = pressure(height) + self._random.gauss(0.0, e.barometer * self._noise)
        fields = ACCELEROMETER | GYROSCOPE
        fields |= MAGNETOMETER if _due("mag", k) else 0
        fields |= BAROMETER if _due("baro", k) else 0
        stamp = round(time * 1e6)
        self._flown.append((p, v))
        out = [
            mavlink.MAVLink_hil_sensor_message(
                stamp, *acc, *gyro, *mag, air, 0.0, _height(air), 15.0 - 0.0065 * height, fields, 0
            )
        ]
        if _due("gps", k):
            out.append(self._gps(stamp, *self._before_delay()))
        if _due("truth", k):
            out.append(_truth(stamp, p, v, q, w, force))
        return out

    def _rates(self, q: Quat, w: Vec) -> Vec:
        """Rates that lead from the attitude that was shown to the one that is; those of the machine where they do."""
        last = self._shown
        turn = (0.0, 0.0, 0.0) if last is None else rotation_vector(multiply(conjugate(last), q))
        off = length((RATE * turn[0] - w[0], RATE * turn[1] - w[1], RATE * turn[2] - w[2]))
        if last is None or off < _STEADY + 0.1 * length(w):
            self._shown = q
            return w
        share = min(FASTEST / max(RATE * length(turn), FASTEST), 1.0) * RATE
        rates: Vec = (share * turn[0], share * turn[1], share * turn[2])
        self._shown = turned_by_rates(last, rates, 1.0 / RATE)
        return rates

    def _before_delay(self) -> tuple[Vec, Vec]:
        """Position and velocity a GPS delay ago, between two samples; the first ones before there were any."""
        (p, v), (p1, v1) = self._flown[0], self._flown[min(1, len(self._flown) - 1)]
        samples = self._errors.gps_delay * RATE
        share = ceil(samples) - samples
        return between(p, p1, share), between(v, v1, share)

    def _gps(self, stamp: int, p: Vec, v: Vec) -> Message:
        at = frames.world(self._noisy(frames.world(p), self._errors.gps))
        n, e, d = self._noisy(frames.world(v), self._errors.gps_velocity)
        lat, lon, alt = place(at)
        course = round(100.0 * degrees(atan2(e, n)) % 36000.0) % 36000
        ground = min(round(100.0 * (n * n + e * e) ** 0.5), 0xFFFF)
        return mavlink.MAVLink_hil_gps_message(
            stamp,
            3,
            lat,
            lon,
            alt,
            30,
            40,
            ground,
            _int16(100.0 * n),
            _int16(100.0 * e),
            _int16(100.0 * d),
            course,
            12,
        )

    def _noisy(self, v: Vec, std: Vec, bias: Vec = (0.0, 0.0, 0.0)) -> Vec:
        gauss, k = self._random.gauss, self._noise
        x, y, z = (a + b + gauss(0.0, k * s) for a, b, s in zip(v, bias, std, strict=True))
        return (x, y, z)


def _int16(value: float) -> int:
    """The nearest whole number that a field of 16 bits holds."""
    return min(max(round(value), -0x7FFF), 0x7FFF)


def _due(sensor: str, count: int) -> bool:
    every, first = _EVERY[sensor]
    return count % every == first


def _height(shown: float) -> float:
    """Height above the sea [m] of a pressure [hPa]."""
    return float((1.0 - (shown / 1013.25) ** (1.0 / 5.25588)) / 2.25577e-5)


def place(p: Vec) -> tuple[int, int, int]:
    """Latitude and longitude [1e-7 deg] and altitude [mm] of a position, on a sphere."""
    lat = LATITUDE + degrees(p[1] / _EARTH)
    lon = LONGITUDE + degrees(p[0] / (_EARTH * cos(radians(LATITUDE))))
    return round(lat * 1e7), round(lon * 1e7), round(1e3 * (ALTITUDE + p[2]))


def _truth(stamp: int, p: Vec, v: Vec, q: Quat, w: Vec, force: Vec) -> Message:
    """The true state, which PX4 writes into its log beside its estimate."""
    lat, lon, alt = place(p)
    n, e, d = (_int16(100.0 * c) for c in frames.world(v))
    acc = (_int16(1e3 * c / GRAVITY) for c in frames.body(force))
    return mavlink.MAVLink_hil_state_quaternion_message(
        stamp, frames.attitude(q), *frames.body(w), lat, lon, alt, n, e, d, 0, 0, *acc
    )
