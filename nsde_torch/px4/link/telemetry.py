"""What the autopilot says, as one consistent state with the time it is valid for, and its status.

The state is ODOMETRY where it comes, else ATTITUDE_QUATERNION with the newest LOCAL_POSITION_NED carried forward to
the attitude's time, p + v (t_attitude - t_position). The velocity of ODOMETRY is taken in the local frame, as PX4 sends
it; where LOCAL_POSITION_NED, whose frame is beyond doubt, says that it is in the body, it is turned.
"""

from collections import deque
from dataclasses import dataclass, field, replace
from math import inf, nan
from typing import final

from nsde_torch.px4.link import frames
from nsde_torch.px4.link.codec import Message
from nsde_torch.px4.link.dialect import ARMED_FLAG, RECEIVER, UNKNOWN, Mode, parameter_value
from nsde_torch.px4.link.vectors import Quat, Vec, distance, finite, length, normalised, plus, rotate

PAIR = 0.1  # longest time over which a position is carried forward to an attitude [s]
BACK = 1.0  # a stamp that lies this far back, several times over, is that of a restarted clock [s]
_TEXTS = 200


@dataclass(frozen=True)
class VehicleState:
    """State of the vehicle, ENU and FLU."""

    time: float  # when it was valid, on our monotonic clock [s]
    stamp: float  # when it was valid, on the autopilot's clock [s]
    received: float  # when it came, on our clock [s]
    p: Vec  # position [m]
    v: Vec  # velocity in the world [m/s]
    q: Quat  # attitude, body to world, `w x y z`
    w: Vec  # body rates [rad/s]
    resets: int = 0
    """Resets of the estimate that the autopilot has announced so far: of heading, position and velocity alike."""

    @property
    def row(self) -> tuple[float, ...]:
        """The 13 numbers of a multirotor's state."""
        return (*self.p, *self.v, *self.q, *self.w)


@dataclass(frozen=True)
class Text:
    """A STATUSTEXT."""

    time: float
    severity: int
    text: str


@dataclass(frozen=True)
class EstimateQuality:
    """What the autopilot's estimator says of itself (ESTIMATOR_STATUS); `nan` where it does not say."""

    time: float  # when it came, on our clock [s]
    velocity_ratio: float
    """Innovation over the gate of its test, squared; above 1 the estimator rejects that sensor."""
    position_ratio: float  # the same of the horizontal position
    height_ratio: float  # the same of the height
    heading_ratio: float  # the same of the heading, or of the magnetometer
    horizontal_m: float  # standard deviation of the horizontal position [m]
    vertical_m: float  # standard deviation of the height [m]


Followed = tuple[float, Vec | None]
"""When the autopilot reported a setpoint that it follows [s], and its body rates, FLU [rad/s]; None: a position."""


@dataclass
class Status:
    """Everything but the state; times on our clock [s], `-inf` where nothing came."""

    heard: float = -inf  # any message
    heartbeat: float = -inf
    mode: Mode = UNKNOWN
    armed: bool = False  # whether motors may turn
    landed: int = 0  # `landed_state` of EXTENDED_SYS_STATE, 0 unknown
    voltage: float = nan  # of the battery [V]
    remaining: float = nan  # charge left, 0 to 1
    motors: tuple[float, ...] = ()  # commands of the motors, 0 to 1, as far as the autopilot reports them
    receiver: bool | None = None  # whether it hears a transmitter; None where it does not say
    home: Vec | None = None  # place of take-off, ENU [m], as far as the autopilot reports it
    quality: EstimateQuality | None = None  # what its estimator says of itself, as far as it is sent
    texts: deque[Text] = field(default_factory=lambda: deque(maxlen=_TEXTS))
    parameters: dict[str, float] = field(default_factory=dict)


@final
class Telemetry:
    """Takes messages, in whatever order and state they come."""

    def __init__(self) -> None:
        self.sync = TimeSync()  # the autopilot's clock
        self.status = Status()
        self.state: VehicleState | None = None  # the newest consistent state, None before the first
        self.history: deque[VehicleState] = deque(maxlen=100)
        """The newest ones, for who looks less often than they come."""
        self.followed: deque[Followed] = deque(maxlen=50)
        """Setpoints that the autopilot says it follows, for who takes them."""
        self.rate = 0.0  # states a second, smoothed over 20 of them
        self._position: tuple[float, Vec, Vec] | None = None
        self._last_odometry = -inf
        self._old = 0
        self._reset_counter: int | None = None
        self._chunk = (0, 0)
        self._resets = 0
        self._evidence = [0.0, 0.0]

    def take(self, message: Message, now: float) -> None:
        """Take one message that came at `now` [s, our clock]."""
        self.status.heard = now
        handler = getattr(self, f"_{message.get_type().lower()}", None)
        if handler is not None:
            handler(message, now)

    # one method a message, named like it

    def _heartbeat(self, m: Message, now: float) -> None:
        s = self.status
        s.heartbeat, s.mode, s.armed = now, Mode.of(m.custom_mode), bool(m.base_mode & ARMED_FLAG)

    def _extended_sys_state(self, m: Message, now: float) -> None:
        self.status.landed = m.landed_state

    def _sys_status(self, m: Message, now: float) -> None:
        self.status.receiver = bool(m.onboard_control_sensors_present & RECEIVER)
        if m.voltage_battery not in (0, 65535):
            self.status.voltage = m.voltage_battery * 1e-3
        if m.battery_remaining >= 0:
            self.status.remaining = m.battery_remaining * 1e-2

    def _statustext(self, m: Message, now: float) -> None:
        text, texts = m.text.rstrip("\x00"), self.status.texts
        if m.id and m.chunk_seq and self._chunk == (m.id, m.chunk_seq - 1) and texts:
            # a text of more than fifty characters comes in pieces
            texts[-1] = replace(texts[-1], text=(texts[-1].text + text).strip())
        else:
            texts.append(Text(now, m.severity, text if m.id else text.strip()))
        self._chunk = (m.id, m.chunk_seq)

    def _home_position(self, m: Message, now: float) -> None:
        at = frames.world((m.x, m.y, m.z))
        self.status.home = at if finite(*at) else None

    def _estimator_status(self, m: Message, now: float) -> None:
        ratios = (m.vel_ratio, m.pos_horiz_ratio, m.pos_vert_ratio, m.mag_ratio)
        self.status.quality = EstimateQuality(now, *ratios, m.pos_horiz_accuracy, m.pos_vert_accuracy)

    def _attitude_target(self, m: Message, now: float) -> None:
        self.followed.append((now, frames.body((m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate))))

    def _position_target_local_ned(self, m: Message, now: float) -> None:
        self.followed.append((now, None))

    def _param_value(self, m: Message, now: float) -> None:
        self.status.parameters[m.param_id.rstrip("\x00")] = parameter_value(m.param_value, m.param_type)

    def _timesync(self, m: Message, now: float) -> None:
        if m.tc1 > 0:
            self.sync.answered(m.tc1 * 1e-9, m.ts1 * 1e-9, now)

    def _servo_output_raw(self, m: Message, now: float) -> None:
        self._motors(tuple(float(getattr(m, f"servo{k}_raw")) for k in range(1, 9)))

    def _actuator_output_status(self, m: Message, now: float) -> None:
        self._motors(tuple(float(v) for v in m.actuator[:8]))

    def _motors(self, raw: tuple[float, ...]) -> None:
        if not finite(*raw):
            return
        if max(raw) > 2.0:  # pulse widths in microseconds
            raw = tuple(min(max((v - 1000.0) * 1e-3, 0.0), 1.0) for v in raw)
        self.status.motors = raw

    def _odometry(self, m: Message, now: float) -> None:
        p = frames.world((m.x, m.y, m.z))
        q = frames.attitude(tuple(m.q))
        v: Vec = (m.vx, m.vy, m.vz)
        w = frames.body((m.rollspeed, m.pitchspeed, m.yawspeed))
        stamp = m.time_usec * 1e-6
        local, turned = frames.world(v), rotate(q, frames.body(v))
        if finite(*q) and self._in_body(local, turned, stamp):
            local = turned
        self._resets += self._reset_counter not in (None, m.reset_counter)
        self._reset_counter = m.reset_counter
        if self._new_state(stamp, now, p, local, q, w):
            self._last_odometry = now

    def _in_body(self, as_local: Vec, as_body: Vec, stamp: float) -> bool:
        """Whether ODOMETRY's velocity was seen to be in the body's frame."""
        if self._position is not None and abs(self._position[0] - stamp) < 0.03:
            truth = self._position[2]
            if length(truth) > 0.5:
                for k, guess in enumerate((as_local, as_body)):
                    self._evidence[k] += min(distance(guess, truth), 1.0)
        return self._evidence[0] > 2.0 * self._evidence[1] + 5.0

    def _local_position_ned(self, m: Message, now: float) -> None:
        p, v = frames.world((m.x, m.y, m.z)), frames.world((m.vx, m.vy, m.vz))
        if finite(*p, *v):
            self._position = (m.time_boot_ms * 1e-3, p, v)

    def _attitude_quaternion(self, m: Message, now: float) -> None:
        if now - self._last_odometry < 0.5 or self._position is None:
            return
        stamp = m.time_boot_ms * 1e-3
        at, p, v = self._position
        ahead = stamp - at
        if abs(ahead) > PAIR:
            return
        q = frames.attitude((m.q1, m.q2, m.q3, m.q4))
        w = frames.body((m.rollspeed, m.pitchspeed, m.yawspeed))
        self._new_state(stamp, now, plus(p, v, ahead), v, q, w)

    def _new_state(self, stamp: float, now: float, p: Vec, v: Vec, q: Quat, w: Vec) -> bool:
        norm = sum(c * c for c in q)
        if not finite(*p, *v, *q, *w) or not 0.9 < norm < 1.1:
            return False
        before = self.state
        if before is not None:
            leap = stamp > before.stamp + BACK and now - before.received < 0.5 * BACK
            if stamp <= before.stamp or leap:
                # late, repeated, or ahead of the time that has passed; a clock that is set says so more than once
                self._old = self._old + 1 if leap or stamp < before.stamp - BACK else 0
                if self._old < 5:
                    return False
                self.sync.reset()
        self._old = 0
        self.sync.arrived(stamp, now)
        # nothing is valid in the future: a state that came is at least as old as its way here
        time = min(self.sync.ours(stamp), now)
        self.state = VehicleState(time, stamp, now, p, v, normalised(q), w, self._resets)
        self.history.append(self.state)
        if before is not None and now > before.received:
            self.rate += 0.05 * (min(1.0 / (now - before.received), 1000.0) - self.rate)
        return True


# The autopilot's clock on ours, by TIMESYNC and by the fastest message.
#
# We send (0, t1); the autopilot answers (tc, t1) at its time tc; at t2 we know
#
#     tc = t + o(t) at t = (t1 + t2) / 2,      error <= (t2 - t1) / 2,      o(t) = a + b t
#
# A clock drifts: that of a simulator by a per cent, which is tens of milliseconds in a few seconds. So `a` and `b` are
# fitted to the answers of the last seconds, each with a weight by how much longer than the shortest its round trip
# was (Mills, RFC 5905, "clock filter", which takes the shortest alone, has the offset of when that was). Without
# answers, the message that came soonest after its stamp bounds the offset from one side.

LONGEST = 1.0  # round trip from which on an answer is not used [s]
JUMP = 0.5  # disagreement with the messages' own stamps from which on the clock has jumped [s]
PERIOD = 0.1  # time between questions [s]
WINDOW = 4.0  # time over which answers are accepted [s]
SLACK, ODD = 0.02, 3
"""Disagreement of an answer with the line, beyond its own error [s], and how many of them in a row set a clock anew."""
SPREAD = 1e-3  # round trips that are this much longer than the shortest have a quarter of its weight [s]
FEWEST, SHORTEST = 8, 0.5  # answers, and time that they span [s], from which a drift is fitted
STEEPEST = 0.1  # largest drift that is accepted


@final
class TimeSync:
    """Offset between two clocks."""

    def __init__(self) -> None:
        self._answers: deque[tuple[float, float, float]] = deque()
        self._soonest: deque[float] = deque(maxlen=50)
        self._line, self._odd = (0.0, 0.0), 0
        self.round_trip: float | None = None  # shortest of the answers that are used [s]; None without any
        self.late: float | None = None
        """Round trip of an answer that came too late to be used [s]; None where the newest did not."""
        self.drift = 0.0  # seconds that their clock gains in one of ours

    def reset(self) -> None:
        """Forget all: the autopilot restarted, or its clock was set."""
        self._answers.clear()
        self._soonest.clear()
        self.round_trip, self.drift = None, 0.0

    def answered(self, theirs: float, sent: float, received: float) -> None:
        """Take an answer to a TIMESYNC of ours; all times in s."""
        trip = received - sent
        self.late = trip if trip >= LONGEST else None
        if not 0.0 <= trip < LONGEST:
            return
        middle = 0.5 * (sent + received)
        strange = bool(self._answers) and abs(theirs - middle - self.offset(middle)) > 0.5 * trip + SLACK
        self._odd = self._odd + 1 if strange else 0
        self._answers.append((middle, theirs - middle, trip))
        if self._odd >= ODD:  # the clock was set
            self._answers = deque(list(self._answers)[-ODD:])
            self._odd = 0
        while self._answers[0][0] < middle - WINDOW:
            self._answers.popleft()
        self._fit()

    def _fit(self) -> None:
        shortest = min(trip for _, _, trip in self._answers)
        weights = [(1.0 + (trip - shortest) / SPREAD) ** -2 for _, _, trip in self._answers]
        total = sum(weights)
        rows = list(zip(weights, self._answers, strict=True))
        t = sum(w * a[0] for w, a in rows) / total
        offset = sum(w * a[1] for w, a in rows) / total
        self.drift = 0.0
        if len(rows) >= FEWEST and self._answers[-1][0] - self._answers[0][0] >= SHORTEST:
            spread = sum(w * (a[0] - t) ** 2 for w, a in rows)
            slope = sum(w * (a[0] - t) * (a[1] - offset) for w, a in rows) / spread
            self.drift = slope if abs(slope) <= STEEPEST else 0.0
        self._line, self.round_trip = (t, offset), shortest

    def arrived(self, stamp: float, received: float) -> None:
        """Take a stamped message."""
        self._soonest.append(stamp - received)
        # a stamp from the future, or one that is late by far: the answers are of another clock
        offset = self.offset(received)
        if self._answers and abs(stamp - received - offset) > JUMP and len(self._soonest) >= 10:
            recent = list(self._soonest)[-10:]
            if max(recent) - min(recent) < 0.1 and abs(recent[-1] - offset) > JUMP:
                self.reset()
                self._soonest.extend(recent)

    def offset(self, time: float) -> float:
        """Their clock minus ours at a time of ours [s]; 0 while nothing is known."""
        if self._answers:
            return self._line[1] + self.drift * (time - self._line[0])
        return max(self._soonest) if self._soonest else 0.0

    def ours(self, stamp: float) -> float:
        """A time of theirs on our clock [s]."""
        if not self._answers:
            return stamp - self.offset(0.0)
        t, offset = self._line
        return t + (stamp - offset - t) / (1.0 + self.drift)
