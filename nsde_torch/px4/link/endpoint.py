"""Our end of a MAVLink connection, without the connection: what to say when, and what was heard.

Time and bytes come in as arguments, so that the same code flies over sockets and, in tests, in virtual time.
"""

import threading
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, replace
from typing import final

from nsde_torch.px4.link import dialect as d
from nsde_torch.px4.link import frames
from nsde_torch.px4.link.codec import Codec, Message
from nsde_torch.px4.link.dialect import Mode, mavlink
from nsde_torch.px4.link.telemetry import PERIOD, Status, Telemetry, VehicleState
from nsde_torch.px4.link.vectors import Vec, finite

INTERVALS: dict[str, float] = {
    "ODOMETRY": 125.0,
    "ATTITUDE_QUATERNION": 125.0,
    "LOCAL_POSITION_NED": 50.0,
    "SERVO_OUTPUT_RAW": 125.0,
    "EXTENDED_SYS_STATE": 5.0,
    "SYS_STATUS": 2.0,
    "ATTITUDE_TARGET": 50.0,
    "POSITION_TARGET_LOCAL_NED": 10.0,
    "ESTIMATOR_STATUS": 5.0,
}
"""Messages that are asked for, with their rates [Hz].

PX4's estimator runs at 125 Hz in simulation: 100 Hz would come as three states after 8 ms each and one after 16. The
two targets are the setpoints that it follows; it sends no position while it follows rates.
"""
_OTHERS = ("HEARTBEAT", "STATUSTEXT", "PARAM_VALUE", "TIMESYNC", "ACTUATOR_OUTPUT_STATUS", "HOME_POSITION")
_IN_ORDER = frozenset(("HEARTBEAT", "STATUSTEXT", "EXTENDED_SYS_STATE", "SYS_STATUS"))
NUMBERS: dict[str, int] = {kind.msgname: number for number, kind in mavlink.mavlink_map.items()}
WANTED = frozenset(NUMBERS[name] for name in (*INTERVALS, *_OTHERS))
HEARTBEATS = 0.2
"""Time between requests for the vehicle's heartbeat [s]; PX4 sends one a second, and no other interval is accepted."""
CHECKED = 2.0  # after this time [s] a message that still comes too slowly is asked for again
SHARE = 0.7  # share of the rate that was asked for with which we are content; PX4 sends 99 Hz for 100


@final
@dataclass(eq=False)
class Endpoint:
    """Says and hears."""

    send: Callable[[bytes], None]  # where bytes go
    _: KW_ONLY
    system: int = 245  # our system id; as a rule that of a ground station
    target: int | None = None  # the vehicle's system id; None: the first autopilot that is heard
    key: bytes | None = None  # signing key; None: no signing
    stream: bool = False  # whether bytes come as a stream

    def __post_init__(self) -> None:
        self.codec = Codec(self.system, 190, key=self.key, wanted=WANTED, stream=self.stream)
        self.telemetry = Telemetry()  # what was heard; hold `lock` to look into it from another thread
        self.lock = threading.RLock()
        self.codec.only = self.target
        self._component = 1
        self._due = {"heartbeat": 0.0, "theirs": 0.0, "timesync": 0.0, "intervals": 0.0}
        self._counts: dict[str, int] = {}
        self._counted_since = 0.0
        self._origin: float | None = None
        self._newest, self._newest_at = 0, -1.0
        self._last: dict[str, int] = {}

    # hearing

    def receive(self, data: bytes, now: float) -> int:
        """Take bytes that came at `now` [s]; returns the number of good messages."""
        count = 0
        with self.lock:
            for message in self.codec.unpack(data, now):
                if self.target is None and not self._adopt(message):
                    continue
                name = message.get_type()
                if name == "HEARTBEAT" and message.autopilot == d.NO_AUTOPILOT:
                    continue  # a camera, or a ground station, of the same system
                if self._overtaken(name, message.get_seq(), now):
                    continue
                self._counts[name] = self._counts.get(name, 0) + 1
                self.telemetry.take(message, now)
                count += 1
        return count

    def _overtaken(self, name: str, seq: int, now: float) -> bool:
        """Whether a message is a copy, or older than the last of its kind; states have stamps that say so better.

        Numbers of frames count to 255 and begin again; they are unwound by the newest frame of all.
        """
        ahead = (seq - self._newest) % 256
        if ahead >= 128 and now - self._newest_at < 0.3:
            ahead -= 256
        count = self._newest + ahead
        if ahead >= 0:
            self._newest, self._newest_at = count, now
        if name not in _IN_ORDER:
            return False
        if count <= self._last.get(name, -1):
            self.codec.counts["overtaken"] += 1
            return True
        self._last[name] = count
        return False

    def _adopt(self, message: Message) -> bool:
        """The first autopilot that introduces itself is ours, and no other from then on."""
        if message.get_type() != "HEARTBEAT" or message.autopilot == d.NO_AUTOPILOT:
            return False
        self.target = self.codec.only = message.get_srcSystem()
        self._component = message.get_srcComponent()
        return True

    @property
    def state(self) -> VehicleState | None:
        """The newest consistent state."""
        return self.telemetry.state

    def status(self) -> Status:
        """What else is known, as a copy."""
        with self.lock:
            s = self.telemetry.status
            return replace(s, texts=s.texts.copy(), parameters=dict(s.parameters))

    # saying

    def say(self, message: Message) -> None:
        with self.lock:
            self.send(self.codec.pack(message))

    def poll(self, now: float) -> None:
        """Say what is due at `now` [s]: heartbeat, time sync, requests for messages. Call it ten times a second."""
        with self.lock:
            if now >= self._due["heartbeat"]:
                self._due["heartbeat"] = now + 1.0
                # as a ground station: PX4 sends its texts to no other
                self.say(mavlink.MAVLink_heartbeat_message(d.GCS, d.NO_AUTOPILOT, 0, 0, 4, 3))
            if self.target is None:
                return
            if now >= self._due["theirs"]:
                self._due["theirs"] = now + HEARTBEATS
                self.command(d.REQUEST_MESSAGE, NUMBERS["HEARTBEAT"])
            if now >= self._due["timesync"]:
                self._due["timesync"] = now + PERIOD
                self.say(mavlink.MAVLink_timesync_message(0, int(now * 1e9)))
            if now >= self._due["intervals"]:
                self._check_intervals(now)
                self._due["intervals"] = now + CHECKED

    def _check_intervals(self, now: float) -> None:
        span = now - self._counted_since
        for name, rate in INTERVALS.items():
            if not self._counted_since or self._counts.get(name, 0) / span < SHARE * rate:
                self.command(d.SET_INTERVAL, NUMBERS[name], 1e6 / rate)
        self._counts, self._counted_since = {}, now

    def command(self, number: int, *parameters: float) -> None:
        """Send a command to the vehicle, once."""
        values = [*parameters, *([0.0] * (7 - len(parameters)))]
        self.say(mavlink.MAVLink_command_long_message(*self._to, number, 0, *values))

    @property
    def _to(self) -> tuple[int, int]:
        return self.target or 0, self._component

    def ask_mode(self, mode: Mode) -> None:
        self.command(d.SET_MODE, 1, mode.main, mode.sub)

    def ask_home(self) -> None:
        """Ask for the place of take-off; it turns up in `status().home`."""
        self.command(d.REQUEST_MESSAGE, NUMBERS["HOME_POSITION"])

    def ask_parameter(self, name: str) -> None:
        """Ask for a parameter; it turns up in `status().parameters`."""
        self.say(mavlink.MAVLink_param_request_read_message(*self._to, name.encode(), -1))

    def send_rates(self, w: Vec, throttle: float, now: float) -> None:
        """Send body rates (FLU) [rad/s] and collective throttle [0, 1].

        Nothing that is not finite leaves here, whatever was meant to be checked before: PX4 would stop the motors.
        """
        if not finite(*w, throttle):
            return
        if self._origin is None:
            self._origin = now
        stamp = int((now - self._origin) * 1e3) & 0xFFFFFFFF
        asked = (d.RATES_MASK, (1.0, 0.0, 0.0, 0.0), *frames.body(w), min(max(throttle, 0.0), 1.0))
        self.say(mavlink.MAVLink_set_attitude_target_message(stamp, *self._to, *asked))
