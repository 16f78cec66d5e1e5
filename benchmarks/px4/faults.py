"""The faults that are made in flight, how each is made, and the end that the documentation promises."""

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.px4.line import Line
from nsde_torch.control import shapes
from nsde_torch.px4.flight.cascade import PathPoints
from nsde_torch.px4.link import dialect as d


@dataclass(frozen=True)
class Flight:
    pid: int  # of `nsde fly`
    line: Line  # between it and PX4


@dataclass(frozen=True)
class Fault:
    name: str  # what happens
    make: Callable[[Flight], None] | None  # makes it; None: a limit that is set beforehand
    status: tuple[int, ...]  # exit statuses that are right
    trouble: tuple[str, ...] = ()  # kinds of trouble that are right; empty: none is written, as it has ended
    words: tuple[str, ...] = ("reference=lemniscate",)  # settings of the flight
    phase: str = "track"  # in which it is made
    after: float = 3.0  # how long into it [s]
    predictive: bool = False  # whether it needs a predictive controller


def _signal(*numbers: int, pause: float = 0.5) -> Callable[[Flight], None]:
    def make(flight: Flight) -> None:
        for k, number in enumerate(numbers):
            if k:
                time.sleep(pause)
            os.kill(flight.pid, number)

    return make


def _set(**what: bool) -> Callable[[Flight], None]:
    def make(flight: Flight) -> None:
        for name, value in what.items():
            setattr(flight.line, name, value)

    return make


def _stop_the_solver(flight: Flight) -> None:
    """The controller's process stands still; it is the child that is not Python's resource tracker."""
    tasks = Path(f"/proc/{flight.pid}/task")
    for child in [int(c) for t in tasks.iterdir() for c in (t / "children").read_text().split()]:
        if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
            os.kill(child, signal.SIGSTOP)


def _fence() -> str:
    """A fence one centimetre outside of the circle."""
    path = PathPoints(shapes.circle())
    rows = [[low - 0.01, high + 0.01] for low, high in zip(path.low[:2], path.high[:2], strict=True)]
    return f"limits.fence={[*rows, [-0.5, 6.0]]}".replace(" ", "")


def faults(px4: int | None) -> list[Fault]:
    """All of them; PX4 is killed last, and only where its process is known."""
    lost = (4,), ("link", "estimate")
    stands = _signal(signal.SIGSTOP, signal.SIGCONT, pause=4.0)
    out: list[Fault] = [
        Fault("killed with -9", _signal(signal.SIGKILL), (-signal.SIGKILL,)),
        Fault("stopped for 4 s", stands, (3,), ("late", "mode", "link")),
        Fault("SIGINT once", _signal(signal.SIGINT), (130,), ("stop",)),
        Fault("SIGINT twice", _signal(signal.SIGINT, signal.SIGINT), (130,), ("stop",)),
        Fault("fence", None, (3,), ("fence",), ("reference=circle", _fence())),
        Fault("speed", None, (3,), ("speed",), ("reference=lemniscate", "limits.speed=1.5")),
        # a predictive controller does not fly plans that tilt too far
        Fault("tilt", None, (3,), ("tilt", "solver"), ("reference=lemniscate", "limits.tilt=15")),
        Fault("no states", _set(stale=True), (3,), ("estimate",)),
        Fault("another client's mode", lambda flight: flight.line.ask(d.LAND), (3,), ("mode",)),
        Fault("link cut at take-off", _set(cut=True), *lost, phase="take off", after=1.5),
        Fault("link cut on the reference", _set(cut=True), *lost),
        Fault("link cut while landing", _set(cut=True), *lost, phase="land", after=0.3),
        Fault("plans late", _stop_the_solver, (3,), ("solver",), predictive=True),
        Fault("battery low", None, (3,), ("battery",), ("reference=lemniscate", "limits.battery=0.85")),
    ]
    if px4 is not None:
        out.append(Fault("PX4 killed", lambda flight: os.kill(px4, signal.SIGKILL), *lost))
    return out


def verdict(fault: Fault, status: int, flight: dict[str, Any] | None, disarmed: bool) -> list[str]:
    """What did not end as it should have; empty: nothing."""
    out = []
    if status not in fault.status:
        out.append(f"exit status {status}, not {' or '.join(map(str, fault.status))}")
    trouble = ((flight or {}).get("trouble") or {}).get("kind")
    if fault.trouble and trouble not in fault.trouble:
        out.append(f"trouble {trouble!r}, not {' or '.join(fault.trouble)}")
    if not disarmed:
        out.append("not disarmed within a minute")
    return out
