"""A machine as PX4's simulator: sensors out, motor commands in, in lockstep.

PX4 connects to us (TCP port 4560 by default), says a heartbeat, and takes its time from HIL_SENSOR. Until its first
HIL_ACTUATOR_CONTROLS we go on in real time, since PX4 cannot boot without a clock that runs; from then on, if it says
that it is in lockstep (bit 0 of `flags`),

    sensors(t_k) -> PX4 -> motors(t_k) -> machine from t_k to t_k+1,

and never faster than real time. An answer that stays out is waited for `PATIENCE` and no longer. When PX4 goes, the
machine is put back on the ground, and the next PX4 finds it new.

Motors are numbered as in PX4: channel k of the controls is motor k (`PWM_MAIN_FUNCk = 100 + k`).
"""

import random
import time
from collections import deque
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from math import atan2, ceil, cos, degrees, isfinite, radians, sin
from typing import final

from nsde_torch.px4.flight.cascade import GRAVITY
from nsde_torch.px4.link import frames
from nsde_torch.px4.link.codec import Codec, Message
from nsde_torch.px4.link.connection import Transport
from nsde_torch.px4.link.dialect import ARMED_FLAG, mavlink
from nsde_torch.px4.link.endpoint import NUMBERS
from nsde_torch.px4.link.vectors import (
    Quat,
    Vec,
    between,
    conjugate,
    distance,
    length,
    multiply,
    plus,
    rotate_back,
    rotation_vector,
    scaled,
    turned_by_rates,
)
from nsde_torch.px4.options import SensorErrors
from nsde_torch.px4.simulator.body import Body
from nsde_torch.systems import Multirotor

# What sensors on a machine would show, as the messages that PX4 takes from a simulator.
#
#     accelerometer = R' (v' + g z),      gyroscope = w,      magnetometer = R' B,
#     p = 1013.25 hPa (1 - 2.25577e-5 h)^5.25588          (International Standard Atmosphere, ISO 2533)
#
# in FRD: at rest the accelerometer shows -g along z. `B` and the place are those of PX4's default home
# (Zurich; World Magnetic Model, rounded). The IMU comes with every message, the others more seldom, each with
# its bits in `fields_updated` (PX4 takes a sensor only if all of its bits are set).

LATITUDE, LONGITUDE, ALTITUDE = 47.397742, 8.545594, 488.0  # of the place of take-off [deg, deg, m]
_STRENGTH, _DECLINATION, _INCLINATION = 0.483, radians(3.0), radians(63.3)
FIELD_NED: Vec = (
    _STRENGTH * cos(_INCLINATION) * cos(_DECLINATION),
    _STRENGTH * cos(_INCLINATION) * sin(_DECLINATION),
    _STRENGTH * sin(_INCLINATION),
)
"""Magnetic field [gauss]."""
RATE = 250.0  # samples of the IMU in a second; it is what PX4 integrates at in simulation
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
    """Sensors with noise, a factor on which is `noise`, biases and delay.

    A delay other than the one that PX4 expects sets its position and velocity apart from its attitude.
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
        """What is sent of one state, ENU and FLU, at a time [s]; call it once for each sample."""
        k, self._count = self._count, self._count + 1
        x, y, z = plus(self._rest, plus(v, self._before, -1.0), RATE)
        gained = (x, y, z + GRAVITY)
        shown = scaled(gained, HARDEST / max(length(gained), HARDEST))
        self._rest, self._before = plus(gained, shown, -1.0), v
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
        due = {sensor for sensor, (every, first) in _EVERY.items() if k % every == first}
        fields |= MAGNETOMETER if "mag" in due else 0
        fields |= BAROMETER if "baro" in due else 0
        stamp = round(time * 1e6)
        self._flown.append((p, v))
        rest = (air, 0.0, _height(air), 15.0 - 0.0065 * height, fields, 0)
        out = [mavlink.MAVLink_hil_sensor_message(stamp, *acc, *gyro, *mag, *rest)]
        if "gps" in due:
            out.append(self._gps(stamp, *self._before_delay()))
        if "truth" in due:
            out.append(_truth(stamp, p, v, q, w, force))
        return out

    def _rates(self, q: Quat, w: Vec) -> Vec:
        """Rates that lead from the attitude that was shown to the one that is; those of the machine where they do."""
        last = self._shown
        turn = (0.0, 0.0, 0.0) if last is None else rotation_vector(multiply(conjugate(last), q))
        off = distance(scaled(turn, RATE), w)
        if last is None or off < _STEADY + 0.1 * length(w):
            self._shown = q
            return w
        share = min(FASTEST / max(RATE * length(turn), FASTEST), 1.0) * RATE
        rates = scaled(turn, share)
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
        speed = (ground, _int16(100.0 * n), _int16(100.0 * e), _int16(100.0 * d))
        return mavlink.MAVLink_hil_gps_message(stamp, 3, lat, lon, alt, 30, 40, *speed, course, 12)

    def _noisy(self, v: Vec, std: Vec, bias: Vec = (0.0, 0.0, 0.0)) -> Vec:
        gauss, k = self._random.gauss, self._noise
        x, y, z = (a + b + gauss(0.0, k * s) for a, b, s in zip(v, bias, std, strict=True))
        return (x, y, z)


def _int16(value: float) -> int:
    """The nearest whole number that a field of 16 bits holds."""
    return min(max(round(value), -0x7FFF), 0x7FFF)


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


PATIENCE = 0.1  # longest wait for the motor commands to a sample [s]
LONGEST = 0.1  # most that is made up for at once when the machine or PX4 was busy [s]
_FIRST = 1.0  # first time that is sent; PX4 takes 0 for no time [s]
_LOCKSTEP = 1


@final
@dataclass(eq=False)
class HilPlant:
    """The machine, whose step must be the IMU's, and its sensors, without a connection and without a clock."""

    body: Body
    _: KW_ONLY
    seed: int  # of the sensors, as what follows
    noise: float = 1.0
    errors: SensorErrors = field(default_factory=SensorErrors)

    def __post_init__(self) -> None:
        if abs(self.body.dt * RATE - 1.0) > 1e-9:
            raise ValueError(f"the machine's step must be {1.0 / RATE:g} s; got {self.body.dt:g} s")
        self.codec = Codec(1, 200, wanted=frozenset((NUMBERS["HIL_ACTUATOR_CONTROLS"],)), stream=True)
        self.controls: tuple[float, ...] = (0.0,) * self.body.nu  # motor commands in force
        self.answers = 0  # messages with motor commands so far
        self.lockstep = False  # whether PX4 says that it waits for us
        self.armed = False  # whether PX4 says that it is armed
        self._sensors = HilSensors(seed=self.seed, noise=self.noise, errors=self.errors)

    @property
    def time(self) -> float:
        """As sent to PX4 [s]."""
        return _FIRST + self.body.time

    def sample(self) -> bytes:
        """What the sensors show now, once a step."""
        b = self.body
        found = self._sensors.messages(self.time, b.p, b.v, b.q, b.w)
        return b"".join(self.codec.pack(m) for m in found)

    def receive(self, data: bytes) -> None:
        for message in self.codec.unpack(data, self.time):
            controls = tuple(float(c) for c in message.controls[: self.body.nu])
            self.armed = bool(message.mode & ARMED_FLAG)
            # what is no number stops that motor; nothing is turned backwards
            self.controls = tuple(
                min(max(c, 0.0), 1.0) if isfinite(c) and self.armed else 0.0 for c in controls
            )
            self.lockstep = bool(message.flags & _LOCKSTEP)
            self.answers += 1


@final
@dataclass(eq=False)
class HilServer:
    """Serves PX4, one after another."""

    make: Callable[[], HilPlant]  # makes the machine anew, on the ground
    transport: Transport  # where PX4 connects
    _: KW_ONLY
    say: Callable[[str], None] = lambda line: None  # takes a line when PX4 comes and goes
    speed: float = 1.0  # seconds of the machine's clock in a second, at most

    def __post_init__(self) -> None:
        self.plant = self.make()  # the machine in service

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        self.say("waiting for PX4")
        while not until():
            early = self.transport.receive(0.05)  # accepts a connection
            if not self.transport.connected:
                continue
            self.say("PX4 is here")
            self.plant.receive(early)
            self._serve(until)
            if not until():
                gone = f"PX4 went after {self.plant.time - _FIRST:.1f} s"
                self.say(f"{gone}; the machine is put back on the ground")
            self.plant = self.make()

    def _serve(self, until: Callable[[], bool]) -> None:
        plant, transport = self.plant, self.transport
        due = time.monotonic()
        while transport.connected and not until():
            answers, sent = plant.answers, time.monotonic()
            transport.send(plant.sample())
            due = max(due + plant.body.dt / self.speed, sent - LONGEST)
            self._hear(due, answers, sent)
            plant.body.step(plant.controls)

    def _hear(self, due: float, answers: int, sent: float) -> None:
        """Until the next sample is due and, in lockstep, this one is answered."""
        plant, transport = self.plant, self.transport
        while transport.connected:
            now = time.monotonic()
            waits = plant.lockstep and plant.answers == answers
            if now - sent > PATIENCE if waits else now >= due:
                return
            plant.receive(transport.receive(max(due - now, 0.0) if not waits else 0.002))


def airframe(system: Multirotor, hover: float) -> dict[str, float]:
    """PX4's parameters that describe a machine: places and turns of the rotors, outputs, and the hovering throttle.

    Roll and pitch moments of a rotor over its thrust are its place, `PX = -pitch, PY = -roll`; one whose reaction turns
    the body left (FLU yaw > 0) turns clockwise itself, which is a negative KM.
    """
    _, roll, pitch, yaw = system.mixing
    out: dict[str, float] = {"CA_AIRFRAME": 0, "CA_ROTOR_COUNT": system.nu}
    for k in range(system.nu):
        out[f"CA_ROTOR{k}_PX"] = round(-pitch[k], 3) + 0.0
        out[f"CA_ROTOR{k}_PY"] = round(-roll[k], 3) + 0.0
        out[f"CA_ROTOR{k}_KM"] = round(-0.05 * yaw[k], 3) + 0.0
    out |= {f"PWM_MAIN_FUNC{k + 1}": 101 + k for k in range(system.nu)}
    return {**out, "MPC_THR_HOVER": round(hover, 2), "THR_MDL_FAC": 0}
