"""The simulated autopilot in real time on a transport."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import final

from nsde_torch.px4.link.transport import Transport
from nsde_torch.px4.simulator.autopilot import SimulatedAutopilot
from nsde_torch.px4.simulator.clock import CLOCK

TICK = 0.004
LONGEST = 0.1
"""Most that is made up for at once when the machine was busy [s]; beyond, its clock slips."""


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
        """Run until asked to stop."""
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
