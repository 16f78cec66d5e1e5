"""A flight in virtual time: the state machine and a simulated vehicle on a line that can be tampered with.

No sockets, no threads and no waiting: forty seconds of flight take some four seconds, and every fault comes at the
same time in every run.
"""

import copyreg
import random
import struct
import threading
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from nsde_torch.control import shapes
from nsde_torch.px4.flight.cascade import CascadeController, PathPoints
from nsde_torch.px4.flight.controller import Inline, Runner
from nsde_torch.px4.flight.offboard import Offboard
from nsde_torch.px4.flight.safety import Limits, Phase, Trouble
from nsde_torch.px4.link import dialect as d
from nsde_torch.px4.link.codec import Codec
from nsde_torch.px4.link.dialect import mavlink
from nsde_torch.px4.link.endpoint import Endpoint
from nsde_torch.px4.link.vectors import Vec, distance
from nsde_torch.px4.options import CLOCK, FlightOptions, SensorErrors
from nsde_torch.px4.simulator.autopilot import SimulatedAutopilot
from nsde_torch.px4.simulator.body import Body

START = 1000.0
TICK = 0.01
SETPOINT = mavlink.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET

BRISK = {
    **{"height": 1.0, "climb_past": 1.0, "climb": 1.2, "hold": 0.3, "idle": 0.4, "spool": 0.4},
    **{"safe_hold": 0.8, "watch": 15.0},
}
"""A flight that waits no longer than it must; it stays below where the heading is reset."""

Line = Callable[[bytes, float], list[tuple[float, bytes]]]
"""What becomes of a frame that was sent at a time: frames and when they arrive."""


def straight(data: bytes, now: float) -> list[tuple[float, bytes]]:
    """A line on which everything arrives, at once."""
    return [(now, data)]


@dataclass
class World:
    """One vehicle, one flight, and what becomes of frames `down` from the vehicle and `up` to it.

    `speed` is that of the vehicle's clock.
    """

    path: PathPoints = field(default_factory=lambda: PathPoints(shapes.hover(duration=4.0, height=1.0)))
    runner: Runner | None = None
    limits: Limits = field(default_factory=Limits)
    options: FlightOptions = field(default_factory=lambda: FlightOptions(**BRISK))
    system: str = "quadrotor"
    key: bytes | None = None
    vehicle_key: bytes | None = None
    parameters: dict[str, float] = field(default_factory=dict)
    heading_error: float | None = None
    errors: SensorErrors = field(default_factory=SensorErrors)
    speed: float = CLOCK
    down: Line = straight
    up: Line = straight
    seed: int = 0

    def __post_init__(self) -> None:
        self.body = Body(self.system, seed=self.seed, latency=0.02)
        faults = {"parameters": self.parameters, "heading_error": self.heading_error, "errors": self.errors}
        self.vehicle = SimulatedAutopilot(self.body, key=self.vehicle_key, seed=self.seed, **faults)
        self.endpoint = Endpoint(self._up, key=self.key)
        self.says: list[str] = []
        runner = self.runner or Inline(CascadeController(self.path))
        how = {"limits": self.limits, "options": self.options, "say": self._say}
        self.flight = Offboard(self.endpoint, runner, self.path, **how)
        self.now = START
        self.setpoints: list[float] = []
        self.errors: list[float] = []
        self.highest = 0.0
        self._to_vehicle: list[tuple[float, int, bytes]] = []
        self._to_us: list[tuple[float, int, bytes]] = []
        self._count = 0
        self._reader = Codec(200, 1, wanted=frozenset({SETPOINT}))

    def _say(self, text: str) -> None:
        self.says.append(text)

    def _up(self, data: bytes) -> None:
        if int.from_bytes(data[7:10], "little") == SETPOINT:
            self.setpoints.append(self.now)
        self._queue(self._to_vehicle, self.up(data, self.now))

    def _queue(self, queue: list[tuple[float, int, bytes]], frames: list[tuple[float, bytes]]) -> None:
        for time, data in frames:
            self._count += 1
            queue.append((time, self._count, data))

    def _due(self, queue: list[tuple[float, int, bytes]]) -> list[bytes]:
        now = sorted(item for item in queue if item[0] <= self.now + 1e-9)
        for item in now:
            queue.remove(item)
        return [data for _, _, data in now]

    @property
    def phase(self) -> Phase:
        return self.flight.phase

    @property
    def phases(self) -> list[str]:
        return [p for _, p, _ in self.flight.outcome.actions]

    def inject(self, data: bytes) -> None:
        self._queue(self._to_us, [(self.now, data)])

    def vehicle_alone(self) -> None:
        """What the vehicle does in a tick."""
        for data in self._due(self._to_vehicle):
            self.vehicle.receive(data)
        for data in self.vehicle.advance((self.now - START) * self.speed):
            self._queue(self._to_us, self.down(data, self.now))

    def tick(self) -> None:
        self.vehicle_alone()
        for data in self._due(self._to_us):
            self.endpoint.receive(data, self.now)
        self.endpoint.poll(self.now)
        self.flight.tick(self.now)
        if self.phase is Phase.TRACK:
            wanted = self.flight._moved(self.path.at(self.now - self.flight.started).p)
            self.errors.append(distance(self.body.p, wanted))
        self.highest = max(self.highest, self.body.p[2])
        self.now += TICK

    def run(self, at: Callable[["World"], None] = lambda world: None, *, longest: float = 120.0) -> "World":
        """Fly until the flight is over, and then until the vehicle has come to rest."""
        while not self.flight.done:
            at(self)
            self.tick()
            assert self.now < START + longest, f"the flight hangs in {self.phase}"
        for _ in range(3000):
            if not self.vehicle.armed and self.body.on_ground:
                break
            self.tick()
        return self

    def until(self, phase: Phase, then: float = 0.0) -> "World":
        """Fly until a phase has lasted for a time [s]."""
        while not (self.phase is phase and self.flight._elapsed >= then):
            self.tick()
            assert self.now < START + 100.0, self.says
            assert not self.flight.done, self.says
        return self

    @property
    def rmse(self) -> float:
        """Of the true position while the reference was tracked [m]."""
        return float((sum(e * e for e in self.errors) / len(self.errors)) ** 0.5)

    @property
    def trouble(self) -> Trouble:
        """What went wrong, as it has to."""
        assert self.flight.outcome.trouble is not None, self.says
        return self.flight.outcome.trouble

    def ended(self, kind: str, said: str) -> None:
        """It went wrong, of this kind and in these words."""
        assert self.trouble.kind == kind, self.says
        assert said in self.trouble.text

    @property
    def flown(self) -> bool:
        """To the end of the reference, and landed, and nothing went wrong."""
        outcome = self.flight.outcome
        return outcome.tracked and outcome.landed and outcome.trouble is None and self.safe

    @property
    def safe(self) -> bool:
        """On the ground, disarmed, and nothing streamed any more."""
        return self.body.on_ground and not self.vehicle.armed and not self.flight.streaming


# what of a world cannot be copied as it is: packers of frames, and the lock of its endpoint
copyreg.pickle(struct.Struct, lambda packer: (struct.Struct, (packer.format,)))
copyreg.pickle(type(threading.RLock()), lambda lock: (threading.RLock, ()))


@cache
def _flown(phase: Phase, then: float, parameters: tuple[tuple[str, float], ...], **given: Any) -> World:
    return World(parameters=dict(parameters), **given).until(phase, then)


def under_way(
    phase: Phase, then: float = 0.0, *, parameters: Mapping[str, float] | None = None, **given: Any
) -> World:
    """A world in which a phase has lasted for a time [s]: a copy of one that is flown there once."""
    return deepcopy(_flown(phase, then, tuple((parameters or {}).items()), **given))


def lossy(share: float, seed: int = 0) -> Line:
    rng = random.Random(seed)
    return lambda data, now: [] if rng.random() < share else [(now, data)]


def delayed(least: float, most: float, seed: int = 0) -> Line:
    """A line that delays frames by different times, so that they overtake each other."""
    rng = random.Random(seed)
    return lambda data, now: [(now + rng.uniform(least, most), data)]


def doubled(after: float) -> Line:
    return lambda data, now: [(now, data), (now + after, data)]


def corrupted(share: float, seed: int = 0) -> Line:
    rng = random.Random(seed)

    def line(data: bytes, now: float) -> list[tuple[float, bytes]]:
        if rng.random() < share:
            at = rng.randrange(len(data))
            data = data[:at] + bytes((data[at] ^ (1 << rng.randrange(8)),)) + data[at + 1 :]
        return [(now, data)]

    return line


def stranger(system: int = 1, component: int = 1, key: bytes | None = None) -> Codec:
    """Someone else who speaks MAVLink."""
    return Codec(system, component, key=key)


def false_mode(codec: Codec) -> bytes:
    """A heartbeat that says that the vehicle is in another mode, disarmed."""
    return codec.pack(mavlink.MAVLink_heartbeat_message(13, d.AUTOPILOT_PX4, 1, d.HOLD.custom, 3, 3))


def false_state(codec: Codec, stamp: float, p: Vec = (100.0, 0.0, -2.0)) -> bytes:
    nothing = [0.0] * 21
    return codec.pack(
        mavlink.MAVLink_odometry_message(
            int(stamp * 1e6), 1, 1, *p, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, nothing, nothing
        )
    )
