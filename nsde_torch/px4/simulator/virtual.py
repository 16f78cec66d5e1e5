"""A link in virtual time: the flight and the simulated vehicle in one thread, without sockets and without waiting.

A flight of forty seconds takes as long as its arithmetic, and the same seed gives the same flight on any machine, busy
or not. What a real link adds, threads and an operating system that is late, is not in it.
"""

from __future__ import annotations

from collections import deque
from typing import final

from nsde_torch.px4.link.connection import POLL, Connection
from nsde_torch.px4.link.endpoint import Endpoint
from nsde_torch.px4.simulator.autopilot import SimulatedAutopilot
from nsde_torch.px4.simulator.clock import CLOCK

START = 1000.0
"""First time of our clock; the vehicle's begins at 0 [s]."""
STEP = 0.002
"""Longest step between looks at what has arrived [s]."""


@final
class VirtualLink(Connection):
    """A connection to a simulated vehicle.

    Args:
        autopilot: The vehicle.
        key: See `Endpoint`.
        latency: Of messages, in each direction [s].
        speed: Seconds of its clock in a second of ours.
    """

    live = False  # Ctrl-C ends the program, not the flight

    def __init__(
        self,
        autopilot: SimulatedAutopilot,
        *,
        key: bytes | None = None,
        latency: float = 0.0,
        speed: float = CLOCK,
    ) -> None:
        self.autopilot, self._latency, self._speed = autopilot, latency, speed
        self.endpoint = Endpoint(self._say, key=key)
        self._time, self._polled = START, START
        self._up: deque[tuple[float, bytes]] = deque()
        self._down: deque[tuple[float, bytes]] = deque()

    def __enter__(self) -> VirtualLink:
        return self

    def now(self) -> float:
        """See `Connection.now`."""
        return self._time

    def pause(self, seconds: float) -> None:
        """See `Connection.pause`."""
        until = self._time + seconds
        while self._time < until - 1e-9:
            self._time = min(self._time + STEP, until)
            while self._up and self._up[0][0] <= self._time + 1e-9:
                self.autopilot.receive(self._up.popleft()[1])
            for frame in self.autopilot.advance((self._time - START) * self._speed):
                self._down.append((self._time + self._latency, frame))
            while self._down and self._down[0][0] <= self._time + 1e-9:
                self.endpoint.receive(self._down.popleft()[1], self._time)
            if self._time - self._polled >= POLL:
                self._polled = self._time
                self.endpoint.poll(self._time)

    def _say(self, data: bytes) -> None:
        self._up.append((self._time + self._latency, data))
