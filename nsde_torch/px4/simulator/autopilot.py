"""A simulated autopilot that behaves towards MAVLink as a real PX4 was seen to, in steps of its rate loop.

    rates: u = pinv(mixing) (thrust, (kw (w_sp - w) + ki integral) / gains), clipped;      250 Hz

What was measured on a real PX4 and holds here: OFFBOARD is accepted when disarmed without a stream and refused at
arming; DO_SET_MODE is answered twice, once always ACCEPTED; texts go only to a link on which a ground station is heard;
setpoints are not sanitised (NaN thrust stops the motors, more than 1 is nearly full, no limits of rates); when the
stream stops the last rates are held for COM_OF_LOSS_T, then it fails over, and when the stream returns it goes back
to OFFBOARD by itself; ODOMETRY's velocity is in the local frame. What its estimator gets wrong is below.
"""

import random
from cmath import rect
from collections import deque
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field, replace
from math import cos, hypot, inf, nan, radians, sin
from typing import final

from nsde_torch.px4.flight.cascade import GRAVITY, Point, SetpointCascade, levelling
from nsde_torch.px4.link import dialect as d
from nsde_torch.px4.link import frames
from nsde_torch.px4.link.codec import Codec, Message
from nsde_torch.px4.link.dialect import Mode, mavlink
from nsde_torch.px4.link.endpoint import NUMBERS
from nsde_torch.px4.link.vectors import (
    Quat,
    Vec,
    bounded,
    finite,
    from_rotation_vector,
    multiply,
    plus,
    yaw_of,
)
from nsde_torch.px4.options import SensorErrors
from nsde_torch.px4.simulator.body import Body

# The state estimate: the truth with noise, and with the errors that PX4's estimator has.
#
#     heading:    q_believed = R_z(e) q until it climbs past 1.5 m above the ground, then e = 0;  1 deg <= |e| <= 9 deg
#     touch-down at v_z = -s:    v_z estimated too low by d, p_z by h;  d' = -d / 1.5 s, d(0) = 0.8 s, h' = d - h / 3 s
#
# PX4 resets its heading there, once in each flight, and ODOMETRY's reset counter grows by one. While the heading is
# wrong accelerations are turned by it, and its velocity innovations show that (ESTIMATOR_STATUS):
#
#     ratio = |s|^2 / (5 * 0.3 m/s)^2,      s' = (R_z(e) - 1) v' - s / 0.5 s      (EKF2_GPS_V_GATE, EKF2_GPS_V_NOISE)
#
# What its accelerometer cannot show of a touch-down it does not know: one at 0.7 m/s takes it half a metre below the
# ground for seconds, and `landed` comes only when the estimate no longer sinks.

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
        self.new_flight()
        self._speed, self._in_air = 0.0, False
        self._sinking, self._sunk = 0.0, 0.0

    @property
    def still(self) -> bool:
        """Whether the estimate does not sink."""
        return self._sinking < STILL

    def new_flight(self) -> None:
        """It was disarmed: the heading is no longer trusted."""
        drawn = self._headings.choice((-1.0, 1.0)) * self._headings.uniform(*HEADING)
        self._error = drawn if self.heading is None else self.heading

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


PARAMETERS: dict[str, tuple[float, int]] = {
    "COM_OF_LOSS_T": (1.0, d.REAL32),
    "COM_OBL_RC_ACT": (4, d.INT32),  # 4: land
    "COM_RC_IN_MODE": (4, d.INT32),  # no sticks
    "COM_RC_OVERRIDE": (1, d.INT32),
    "COM_RCL_EXCEPT": (0, d.INT32),
    "COM_DLL_EXCEPT": (0, d.INT32),
    "NAV_RCL_ACT": (2, d.INT32),
    "NAV_DLL_ACT": (0, d.INT32),
    "GF_ACTION": (2, d.INT32),
    "GF_MAX_HOR_DIST": (0.0, d.REAL32),  # 0: no fence
    "GF_MAX_VER_DIST": (0.0, d.REAL32),
    "SENS_GPS0_DELAY": (10.0, d.REAL32),
    "COM_LOW_BAT_ACT": (2, d.INT32),
    "RTL_RETURN_ALT": (30.0, d.REAL32),
    "SDLOG_PROFILE": (147, d.INT32),
    "COM_DISARM_LAND": (2.0, d.REAL32),
    "COM_DISARM_PRFLT": (10.0, d.REAL32),
    "MPC_THR_HOVER": (0.5, d.REAL32),
    "MPC_LAND_SPEED": (0.7, d.REAL32),
    "MC_ROLLRATE_MAX": (220.0, d.REAL32),
}
"""The parameters that are answered for."""
FAILSAFES = {0: d.POSITION, 1: d.ALTITUDE, 2: d.MANUAL, 4: d.LAND}
"""Modes of COM_OBL_RC_ACT in which it ends without a stream; HOLD in all others."""
MOTORS_OFF = (6, 7)
"""Values of COM_OBL_RC_ACT that stop the motors wherever it is: flight termination, and disarming."""
STICK_MODES = (d.POSITION, d.ALTITUDE, d.MANUAL)
ABANDONED = 0.85
"""Share of its weight that it carries in a mode of sticks that nobody holds: it drifts on, into the ground."""
BOOT = 1.0  # time until the estimator is ready [s]
RATE_GAINS, RATE_INTEGRAL = (11.0, 11.0, 5.0), (4.0, 4.0, 2.0)
CUT = 0.012  # time for which the motors stand still when LAND follows OFFBOARD [s]
BRAKES = 3.0  # [m/s2], with which a mode of its own comes to where it then stays
LOW_BATTERY = 0.1
NEARLY_FULL = 0.95  # what a thrust above 1 becomes
_NAMES = {number: name for name, number in NUMBERS.items()}
ESTIMATOR = 0.008  # step at which the estimator publishes [s]
_ESTIMATED = frozenset(("ODOMETRY", "LOCAL_POSITION_NED"))
_COMMANDS = {d.SET_MODE: "mode", d.ARM: "arm", d.SET_INTERVAL: "interval", d.REQUEST_MESSAGE: "message"}


@final
@dataclass(eq=False)
class SimulatedAutopilot:
    """A vehicle without a connection: bytes in by `receive`, bytes out from `advance`, on its own clock."""

    body: Body
    _: KW_ONLY
    system: int = 1  # its MAVLink system id
    key: bytes | None = None  # for signing; with one, unsigned messages are ignored
    seed: int = 0  # of the estimate's noise
    sensor_noise: float = 1.0  # factor on the estimate's noise
    stream: bool = False  # whether bytes come as a stream
    parameters: dict[str, float] = field(default_factory=dict)  # values other than those of `PARAMETERS`
    heading_error: float | None = None  # see `SimulatedEstimator`
    errors: SensorErrors = field(default_factory=SensorErrors)  # likewise

    def __post_init__(self) -> None:
        self.codec = Codec(self.system, 1, key=self.key, stream=self.stream)
        self.parameters = {**{k: v for k, (v, _) in PARAMETERS.items()}, **self.parameters}
        self.mode = self.intended = d.HOLD  # in force, and what was asked for and comes back after a failsafe
        self.armed = self.failsafe = False  # `armed`: the motors may turn
        self.clock_error = 0.0  # added to every time stamp that is sent [s]
        self.blind = False  # no state is sent, as when the estimator is lost
        self.mute = False
        std = tuple(self.sensor_noise * self.body._spec.sensor_std[k] for k in (0, 3, 6, 9))
        self.estimator = SimulatedEstimator(
            std=std, seed=self.seed, heading=self.heading_error, errors=self.errors
        )
        self._out: deque[bytes] = deque()
        self._due: dict[str, tuple[float, float]] = {"HEARTBEAT": (0.0, 1.0), "SYS_STATUS": (0.0, 1.0)}
        self._gcs, self._texts = -inf, 0
        self._setpoint: tuple[float, Vec, float] | None = None  # time, rates and throttle
        self._wanted: Point | None = None  # of the newest setpoint, where that is a position
        self.rates: Vec = (0.0, 0.0, 0.0)  # of the body, which it follows [rad/s]
        # position that it followed since the last report [m]; None where it followed rates
        self.position: Vec | None = None
        self.home: Vec | None = None  # place of take-off [m], None before the first arming
        self._integral: Vec = (0.0, 0.0, 0.0)
        self._cascade = SetpointCascade()
        self._point = Point((0.0, 0.0, 0.0))
        self._armed_at = self._landed_at = self._cut_until = 0.0
        # position, velocity, attitude and rates as its estimator has them
        self.estimate: Estimate = ((0.0,) * 3, (0.0,) * 3, (1.0, 0.0, 0.0, 0.0), (0.0,) * 3)
        self.commands: tuple[float, ...] = (0.0,) * self.body.nu  # of the motors
        self.flown = False

    # time

    @property
    def time(self) -> float:
        """Its clock [s]."""
        return self.body.time

    @property
    def landed(self) -> bool:
        """Whether its estimate is that it has landed."""
        return self.body.on_ground and self.estimator.still

    def advance(self, until: float) -> list[bytes]:
        """Run until a time of its clock [s]; returns the frames that it sends."""
        while self.body.time < until - 1e-9:
            self._tick()
        out = list(self._out)
        self._out.clear()
        return [] if self.mute else out

    def _tick(self) -> None:
        now, body = self.body.time, self.body
        self.estimate = self.estimator.sense(body)
        if self.estimator.stepped:  # a heading that is held is held as it is
            self._point = replace(self._point, yaw=self._point.yaw + self.estimator.stepped)
        self._failsafe(now)
        self.commands = self._control(now) if self.armed else (0.0,) * body.nu
        body.step(self.commands)
        self._automatic(now)
        late = now % ESTIMATOR
        published = min(late, ESTIMATOR - late) < 1e-6
        for name, (due, interval) in list(self._due.items()):
            estimated = name in _ESTIMATED
            if now < due - 1e-6 or (estimated and not published):
                continue
            # an estimate is sent as often as it was asked for, at 100 Hz three after 8 ms each and one after 16; of the
            # others 100 Hz come as 99
            due += interval if estimated else interval * 100.0 / 99.0
            self._due[name] = (max(due, now - interval if estimated else now), interval)
            self._report(name, now)

    # modes

    @property
    def streaming(self) -> bool:
        longest = self.parameters["COM_OF_LOSS_T"]
        return self._setpoint is not None and self.time - self._setpoint[0] <= longest

    def set_mode(self, mode: Mode) -> None:
        """Change the mode, as an operator's switch does."""
        self.intended = mode
        self._enter(mode)

    def _enter(self, mode: Mode) -> None:
        if mode != self.mode:
            if self.mode == d.OFFBOARD and mode == d.LAND:
                self._cut_until = self.time + CUT
            p, v, q = self.estimate[:3]
            way = hypot(v[0], v[1]) / (2.0 * BRAKES)
            self._point = Point((p[0] + way * v[0], p[1] + way * v[1], p[2]), yaw=yaw_of(q))
            self._cascade.reset()
            self.mode = mode

    def _failsafe(self, now: float) -> None:
        if not self.armed:
            return
        if self.mode == d.OFFBOARD and not self.streaming:
            self.failsafe = True
            self._text(2, "Failsafe activated: offboard control signal lost")
            action = int(self.parameters["COM_OBL_RC_ACT"])
            self._enter(FAILSAFES.get(action, d.HOLD))
            if action in MOTORS_OFF:
                self._disarm("Disarmed by failsafe")
        elif self.failsafe and self.intended == d.OFFBOARD and self.streaming:
            self.failsafe = False
            self._enter(d.OFFBOARD)

    def _automatic(self, now: float) -> None:
        """Disarming by itself, after landing and before a flight that does not begin."""
        if not self.armed:
            return
        self.flown = self.flown or not self.body.on_ground
        if not self.landed:
            self._landed_at = now
        wait = self.parameters["COM_DISARM_LAND"]
        if self.landed and self.flown and self.mode == d.LAND and now - self._landed_at > wait > 0:
            self._disarm("Disarmed by landing")
        wait = self.parameters["COM_DISARM_PRFLT"]
        if not self.flown and now - self._armed_at > wait > 0:
            self._disarm("Disarmed by auto preflight disarming")

    def _disarm(self, text: str) -> None:
        self.armed = self.failsafe = False
        self.estimator.new_flight()
        self._integral = (0.0, 0.0, 0.0)
        self._text(6, text)

    # control

    def _control(self, now: float) -> tuple[float, ...]:
        p, v, q, w = self.estimate
        dt = self.body.dt
        if self.mode == d.OFFBOARD and self._wanted is None:
            assert self._setpoint is not None
            _, rates, thrust = self._setpoint
            if not finite(thrust, *rates):
                return (0.0,) * self.body.nu  # PX4 does not sanitise them: the motors stop
            throttle = min(thrust, NEARLY_FULL) if thrust > 1.0 else max(thrust, 0.0)
            self.rates = rates
            # thrust of mean command, as the mixer of PX4 has it
            lift = self.body._gain * self.body.nu * throttle
        else:
            if now < self._cut_until:
                return (0.0,) * self.body.nu
            if self.mode == d.LAND:
                speed = self.parameters["MPC_LAND_SPEED"]
                x, y, z = self._point.p
                self._point = Point(
                    (x, y, max(z - speed * dt, p[2] - 1.0)), (0.0, 0.0, -speed), yaw=self._point.yaw
                )
                if self.body.on_ground:
                    return (0.02,) * self.body.nu
            elif self.body.on_ground and self.mode != d.OFFBOARD:
                return (0.1,) * self.body.nu
            if self.failsafe and self.mode in STICK_MODES:
                return self._rates(levelling(q), ABANDONED * GRAVITY - self.body._offset, w, dt)
            to = self._wanted if self.mode == d.OFFBOARD and self._wanted is not None else self._point
            demand = self._cascade(p, v, q, to, dt)
            rates, lift = demand.w, demand.thrust - self.body._offset
            self.rates, self.position = rates, to.p
        return self._rates(rates, lift, w, dt)

    def _rates(self, wanted: Vec, lift: float, w: Vec, dt: float) -> tuple[float, ...]:
        error = plus(wanted, w, -1.0)
        if self.body.on_ground:
            self._integral = (0.0, 0.0, 0.0)
        else:
            x, y, z = (s + k * dt * e for s, k, e in zip(self._integral, RATE_INTEGRAL, error, strict=True))
            self._integral = bounded((x, y, z), 5.0)
        demand = (lift, *(k * e + s for k, e, s in zip(RATE_GAINS, error, self._integral, strict=True)))
        columns = zip(*self.body.allocation, strict=True)
        motors = (sum(k * a for k, a in zip(demand, column, strict=True)) for column in columns)
        return tuple(float(min(max(u, 0.0), 1.0)) for u in motors)

    # hearing

    def receive(self, data: bytes) -> None:
        for message in self.codec.unpack(data, self.time):
            handler = getattr(self, f"_on_{message.get_type().lower()}", None)
            if handler is not None:
                handler(message)

    def _on_heartbeat(self, m: Message) -> None:
        if m.type == d.GCS:
            self._gcs = self.time

    def _on_timesync(self, m: Message) -> None:
        if m.tc1 == 0:
            now = int((self.time + self.clock_error) * 1e9) or 1
            self._send(mavlink.MAVLink_timesync_message(now, m.ts1))

    def _on_set_attitude_target(self, m: Message) -> None:
        rates = frames.body((m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate))
        self._setpoint = (self.time, rates, m.thrust)
        self._wanted = None

    def _on_set_position_target_local_ned(self, m: Message) -> None:
        self._wanted = Point(frames.world((m.x, m.y, m.z)), yaw=yaw_of(self.estimate[2]))
        self._setpoint = (self.time, (0.0, 0.0, 0.0), 0.0)

    def _on_param_request_read(self, m: Message) -> None:
        name = m.param_id.rstrip("\x00")
        if name in self.parameters:
            kind = PARAMETERS[name][1]
            value = d.parameter_number(self.parameters[name], kind)
            place = (len(self.parameters), list(self.parameters).index(name))
            self._send(mavlink.MAVLink_param_value_message(name.encode(), value, kind, *place))

    def _on_command_long(self, m: Message) -> None:
        """Each of the methods that follow does a command, and returns what is acknowledged and, if need be, a text."""
        name = _COMMANDS.get(m.command)
        answer, said = (d.UNSUPPORTED, "") if name is None else getattr(self, f"_command_{name}")(m)
        if said:
            self._text(2, said)
        self._ack(m.command, answer)
        if m.command == d.REQUEST_MESSAGE and answer == d.ACCEPTED:
            self._report(_NAMES[int(m.param1)], self.time)

    def _command_mode(self, m: Message) -> tuple[int, str]:
        mode = Mode(int(m.param2), int(m.param3))
        self._ack(d.SET_MODE, d.ACCEPTED)  # always, whatever comes of it
        if mode not in d.NAMES:
            return d.DENIED, ""
        if mode == d.OFFBOARD and self.armed and not self.streaming:
            return d.TEMPORARILY_REJECTED, "Switching to mode 'Offboard' is currently not available"
        self.failsafe = False
        self.set_mode(mode)
        return d.ACCEPTED, ""

    def _command_arm(self, m: Message) -> tuple[int, str]:
        arms = m.param1 >= 0.5
        if arms and (reason := self._why_not_arm()) is not None:
            return d.TEMPORARILY_REJECTED, f"Arming denied: {reason}"
        if not arms and self.armed and not self.landed:
            return d.TEMPORARILY_REJECTED, "Disarming denied: not landed"
        if arms and not self.armed:
            self.armed, self.flown = True, False
            self.home = self.estimate[0]
            self._armed_at = self._landed_at = self.time
            self._text(6, "Armed by external command")
        elif not arms and self.armed:
            self._disarm("Disarmed by external command")
        return d.ACCEPTED, ""

    def _why_not_arm(self) -> str | None:
        if self.time < BOOT or self.blind:
            return "system not ready, no local position estimate"
        if 1.0 - self.body.used < LOW_BATTERY:
            return "low battery"
        if self.mode == d.OFFBOARD and not self.streaming:
            return "no offboard signal"
        if self.mode == d.LAND:
            return "mode not suitable for takeoff"
        return None

    def _command_interval(self, m: Message) -> tuple[int, str]:
        name = _NAMES.get(int(m.param1), "")
        if name == "HEARTBEAT" or self._reporter(name) is None:
            return d.DENIED, ""
        if m.param2 < 0:
            self._due.pop(name, None)
        else:
            self._due[name] = (self.time, max(m.param2 * 1e-6, self.body.dt))
        return d.ACCEPTED, ""

    def _command_message(self, m: Message) -> tuple[int, str]:
        return d.DENIED if self._reporter(_NAMES.get(int(m.param1), "")) is None else d.ACCEPTED, ""

    # saying

    def _reporter(self, name: str) -> Callable[[float], Message | None] | None:
        """What makes a message of a name; None where it does not send it."""
        reporter: Callable[[float], Message | None] | None = getattr(self, f"_say_{name.lower()}", None)
        return reporter

    def _send(self, message: Message) -> None:
        self._out.append(self.codec.pack(message))

    def _ack(self, command: int, result: int) -> None:
        self._send(mavlink.MAVLink_command_ack_message(command, result))

    def _text(self, severity: int, text: str) -> None:
        self._texts += 1
        if self.time - self._gcs >= 5.0:
            return
        data = text.encode()
        pieces = [data[k : k + 50] for k in range(0, len(data), 50)]
        number = self._texts if len(pieces) > 1 else 0
        for k, piece in enumerate(pieces):
            self._send(mavlink.MAVLink_statustext_message(severity, piece, id=number, chunk_seq=k))

    def _report(self, name: str, now: float) -> None:
        reporter = self._reporter(name)
        if reporter is None or (self.blind and name in _ESTIMATED):
            return
        message = reporter(now + self.clock_error)
        if message is not None:
            self._send(message)

    # one method a message that is sent, named like it; each takes the time that it stamps [s]

    def _say_heartbeat(self, now: float) -> Message:
        flags = 1 | (d.ARMED_FLAG if self.armed else 0)
        state = 4 if self.armed else 3
        return mavlink.MAVLink_heartbeat_message(13, d.AUTOPILOT_PX4, flags, self.mode.custom, state, 3)

    def _say_sys_status(self, now: float) -> Message:
        left, millivolts = round(100 * (1.0 - self.body.used)), round(1000 * self.body.voltage)
        return mavlink.MAVLink_sys_status_message(0, 0, 0, 0, millivolts, -1, left, *[0] * 6)

    def _say_extended_sys_state(self, now: float) -> Message:
        return mavlink.MAVLink_extended_sys_state_message(0, d.ON_GROUND if self.landed else d.IN_AIR)

    def _say_odometry(self, now: float) -> Message:
        p, v, q, w = self.estimate
        unknown = [nan] * 21
        where = (*frames.world(p), frames.attitude(q), *frames.world(v), *frames.body(w), unknown, unknown)
        resets = self.estimator.resets % 256
        return mavlink.MAVLink_odometry_message(int(now * 1e6), 1, 1, *where, reset_counter=resets)

    def _say_attitude_quaternion(self, now: float) -> Message:
        turned = (*frames.attitude(self.estimate[2]), *frames.body(self.estimate[3]))
        return mavlink.MAVLink_attitude_quaternion_message(int(now * 1e3), *turned)

    def _say_local_position_ned(self, now: float) -> Message:
        p, v, _, _ = self.estimate
        return mavlink.MAVLink_local_position_ned_message(int(now * 1e3), *frames.world(p), *frames.world(v))

    def _say_attitude_target(self, now: float) -> Message:
        target = ((1.0, 0.0, 0.0, 0.0), *frames.body(self.rates), 0.0)
        return mavlink.MAVLink_attitude_target_message(int(now * 1e3), 0, *target)

    def _say_position_target_local_ned(self, now: float) -> Message | None:
        """Only where a position was followed since the last report."""
        to, self.position = self.position, None
        if to is None:
            return None
        at = (*frames.world(to), *[0.0] * 8)
        return mavlink.MAVLink_position_target_local_ned_message(int(now * 1e3), 1, 0, *at)

    def _say_estimator_status(self, now: float) -> Message:
        e = self.estimator
        ratios = (e.velocity_ratio, e.contradicted, e.contradicted, 0.02, nan, nan)
        return mavlink.MAVLink_estimator_status_message(int(now * 1e6), 0x33F, *ratios, 0.2, 0.2)

    def _say_home_position(self, now: float) -> Message | None:
        """Known from the first arming on."""
        if self.home is None:
            return None
        unturned = [1.0, 0.0, 0.0, 0.0]
        return mavlink.MAVLink_home_position_message(0, 0, 0, *frames.world(self.home), unturned, *[0.0] * 3)

    def _say_servo_output_raw(self, now: float) -> Message:
        pulses = [round(1000 + 1000 * u) for u in self.commands]
        pulses += [0] * (8 - len(pulses))
        return mavlink.MAVLink_servo_output_raw_message(int(now * 1e6) & 0xFFFFFFFF, 0, *pulses)
