"""Where a controller runs: in the loop itself, or in a process of its own that the loop never waits for.

A process gets a state only when it has answered for the one before, so nothing piles up, and sees the newest. If it
hangs, no plan comes; if it dies, the pipe says so; either way the loop goes on and knows.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import final

from nsde_torch.px4.controller import Controller, Plan
from nsde_torch.px4.vectors import finite

Maker = Callable[[], Controller]
"""Makes a controller, in the process that it is to run in."""


class Runner(ABC):
    """Runs a controller.

    Attributes:
        plan: The newest plan.
        fault: Why there will be no more.
        ready: Whether the controller is made.
    """

    plan: Plan | None = None
    fault: str | None = None
    ready: bool = False

    @abstractmethod
    def offer(self, row: tuple[float, ...], time: float, t: float) -> None:
        """A new state (see `Controller`); it is planned for now, later or not at all."""

    def collect(self) -> None:  # noqa: B027
        """Take what has come."""

    def close(self) -> None:  # noqa: B027
        """End it."""

    def _take(self, plan: Plan) -> None:
        """A plan that is not finite is none."""
        if all(finite(*d.w, d.thrust) for d in plan.demands) and plan.demands and plan.dt > 0:
            self.plan = plan


@final
class Inline(Runner):
    """In the loop: for controllers that take microseconds.

    Args:
        controller: The controller.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller, self.ready = controller, True

    def offer(self, row: tuple[float, ...], time: float, t: float) -> None:
        """See `Runner.offer`."""
        if self.fault is not None:
            return
        try:
            self._take(self._controller(row, time, t))
        except Exception as error:  # any fault of a controller ends in the safe action, not in a crash
            self.fault = f"{type(error).__name__}: {error}"


@final
class Process(Runner):
    """In a process of its own.

    Args:
        maker: Makes the controller over there; it must be importable by name.
    """

    def __init__(self, maker: Maker) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_work, args=(maker, theirs), name="controller", daemon=True)
        self._process.start()
        theirs.close()
        self._busy = True  # until it says that it is ready

    @property
    def pid(self) -> int | None:
        """Its process id."""
        return self._process.pid

    def offer(self, row: tuple[float, ...], time: float, t: float) -> None:
        """See `Runner.offer`."""
        if self._busy or self.fault is not None:
            return
        try:
            self._pipe.send((row, time, t))
            self._busy = True
        except (OSError, ValueError):
            self.fault = self.fault or "the controller's process is gone"

    def collect(self) -> None:
        """See `Runner.collect`."""
        try:
            while self.fault is None and self._pipe.poll():
                answer = self._pipe.recv()
                self._busy = False
                if answer is None:
                    self.ready = True
                elif isinstance(answer, Plan):
                    self._take(answer)
                else:
                    self.fault = str(answer)
        except (EOFError, OSError):
            self.fault = "the controller's process is gone"

    def close(self) -> None:
        """See `Runner.close`."""
        with contextlib.suppress(OSError):
            self._pipe.close()
        self._process.join(0.5)
        if self._process.is_alive():
            self._process.kill()
            self._process.join(1.0)


def _work(maker: Maker, pipe: Connection) -> None:
    """What runs in the process."""
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C is the loop's business: it needs plans until it has landed
    with contextlib.suppress(OSError, AttributeError):
        os.nice(1)  # the stream goes first
    try:
        controller = maker()
        pipe.send(None)
        while True:
            row, stamp, t = pipe.recv()
            started = time.perf_counter()
            plan = controller(row, stamp, t)
            took = 1e3 * (time.perf_counter() - started)
            pipe.send(Plan(plan.time, plan.dt, plan.demands, plan.status, plan.solve_ms or took))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
    except Exception as error:  # said to the loop, which then lands
        lines = traceback.format_exc().strip().splitlines()
        with contextlib.suppress(OSError):
            pipe.send(f"{type(error).__name__}: {error} ({lines[-3].strip() if len(lines) > 2 else ''})")
