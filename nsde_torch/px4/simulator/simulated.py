"""The simulated vehicle, and flights on it: in real time on a transport, and in virtual time.

In virtual time the flight and the vehicle are in one thread, with the same link, state machine and logs, without
sockets and without waiting. A flight of forty seconds takes as long as its arithmetic, and the same seed gives the same
flight on any machine, busy or not. What a real link adds, threads and an operating system that is late, is not in it.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import final

from nsde_torch.px4.flight.cascade import PathPoints
from nsde_torch.px4.flight.controller import FlightController, Inline
from nsde_torch.px4.flight.flying import FlightReport, fly
from nsde_torch.px4.link.connection import POLL, Connection, Transport
from nsde_torch.px4.link.endpoint import Endpoint
from nsde_torch.px4.options import CLOCK, FlightOptions
from nsde_torch.px4.simulator.autopilot import SimulatedAutopilot
from nsde_torch.px4.simulator.body import Body

START = 1000.0  # first time of our clock; the vehicle's begins at 0 [s]
STEP = 0.002  # longest step between looks at what has arrived [s]


@final
@dataclass(eq=False)
class VirtualLink(Connection):
    """A connection to a simulated vehicle."""

    live = False  # Ctrl-C ends the program, not the flight

    autopilot: SimulatedAutopilot  # the vehicle, whose clock runs as that of PX4's own simulator (`CLOCK`)
    _: KW_ONLY
    key: bytes | None = None  # see `Endpoint`
    latency: float = 0.0  # of messages, in each direction [s]

    def __post_init__(self) -> None:
        self.endpoint = Endpoint(self._say, key=self.key)
        self._time, self._polled = START, START
        self._up: deque[tuple[float, bytes]] = deque()
        self._down: deque[tuple[float, bytes]] = deque()

    def now(self) -> float:
        return self._time

    def pause(self, seconds: float) -> None:
        until = self._time + seconds
        while self._time < until - 1e-9:
            self._time = min(self._time + STEP, until)
            while self._up and self._up[0][0] <= self._time + 1e-9:
                self.autopilot.receive(self._up.popleft()[1])
            for frame in self.autopilot.advance((self._time - START) * CLOCK):
                self._down.append((self._time + self.latency, frame))
            while self._down and self._down[0][0] <= self._time + 1e-9:
                self.endpoint.receive(self._down.popleft()[1], self._time)
            if self._time - self._polled >= POLL:
                self._polled = self._time
                self.endpoint.poll(self._time)

    def _say(self, data: bytes) -> None:
        self._up.append((self._time + self.latency, data))


LINE = 0.005  # time that a message takes on the simulated line [s]
SOLVE = 0.01  # time after which a plan is there: a solve, rounded up to a tick of the loop [s]


def fly_simulated(
    body: Body,
    controller: FlightController,
    path: PathPoints,
    *,
    seed: int,
    period: float,
    sensor_noise: float = 1.0,
    options: FlightOptions | None = None,
    log: Path | None = None,
) -> FlightReport:
    """Fly once, from the ground to the ground, in virtual time.

    Args:
        body: The machine, on the ground.
        seed: Of the noise of the estimate; `sensor_noise` is a factor on it.
        period: Time between plans [s].
        options, log: See `fly`.

    Returns:
        What was measured; the same for the same seeds on every machine on which arithmetic is the same.
    """
    autopilot = SimulatedAutopilot(body, seed=seed, sensor_noise=sensor_noise)
    runner = Inline(controller, period=period, delay=SOLVE)
    with VirtualLink(autopilot, latency=LINE) as link:
        return fly(link, runner, path, motors=body.nu, log=log, options=options)


TICK = 0.004
LONGEST = 0.1  # most that is made up for at once when the machine was busy [s]; beyond, its clock slips


@final
@dataclass(eq=False)
class Vehicle:
    """Runs a simulated autopilot on a transport; a context manager does so in a thread."""

    autopilot: SimulatedAutopilot
    transport: Transport
    _: KW_ONLY
    speed: float = CLOCK  # seconds of its clock in one of ours

    def __post_init__(self) -> None:
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.run, name="vehicle", daemon=True)
        self.slipped = 0.0  # time that its clock lost because the machine was busy [s]

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        begun, offset = time.monotonic(), self.autopilot.time
        while not (self._stop.is_set() or until()):
            wanted = offset + (time.monotonic() - begun) * self.speed
            behind = wanted - self.autopilot.time
            if behind > LONGEST:
                self.slipped += behind - LONGEST
                offset -= behind - LONGEST
                wanted -= behind - LONGEST
            for frame in self.autopilot.advance(wanted):
                self.transport.send(frame)
            wait = TICK
            while data := self.transport.receive(wait):
                self.autopilot.receive(data)
                wait = 0.0

    def __enter__(self) -> Vehicle:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join(2.0)
        self.transport.close()
