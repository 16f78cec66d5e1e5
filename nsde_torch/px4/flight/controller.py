"""What a controller is to the link, and where it runs: in the loop itself, or in a process that is never waited for.

A controller is a callable from a state and a time to body rates and collective thrust. A process gets a state only when
it has answered for the one before, so nothing piles up, and sees the newest. If it hangs, no plan comes; if it dies,
the pipe says so; either way the loop goes on and knows.
"""

import contextlib
import multiprocessing
import os
import signal
import time
import traceback
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from math import inf
from multiprocessing.connection import Connection
from typing import Protocol, final

from nsde_torch.errors import NsdeError
from nsde_torch.px4.link.connection import PLANS, urgent
from nsde_torch.px4.link.vectors import Vec, between, finite

TIPPED = "tipped"  # word of a status: a plan tilted too far


@dataclass(frozen=True)
class Demand:
    """What is asked of the vehicle at one time."""

    w: Vec  # body rates, FLU [rad/s]
    thrust: float  # collective thrust over mass, along the body's z axis [m/s2]


@dataclass(frozen=True)
class DemandPlan:
    """What a controller returns: demands from now on."""

    time: float  # from when the first demand holds, on our clock [s]
    dt: float  # time between demands [s]
    demands: tuple[Demand, ...]
    """One or more; between two of them both are mixed, the last one holds for `dt`."""
    status: str = "ok"
    """One word or two; `failed` in it means that the controller itself does not trust it, `TIPPED` that the plan that
    it replaces tilted too far."""
    solve_ms: float = 0.0  # time that it took

    def at(self, time: float) -> Demand:
        """The demand at a time; before the first and after the last those two."""
        s = max((time - self.time) / self.dt, 0.0)
        k = int(s)
        if k >= len(self.demands) - 1:
            return self.demands[-1]
        a, b, share = self.demands[k], self.demands[k + 1], s - k
        return Demand(between(a.w, b.w, share), a.thrust + share * (b.thrust - a.thrust))


Asked = Sequence[tuple[float, Demand]]  # what was sent lately, and when it left [s], the oldest first


class FlightController(Protocol):
    """What plans."""

    def __call__(self, row: tuple[float, ...], time: float, t: float, asked: Asked = ()) -> DemandPlan:
        """Plan.

        Args:
            row: State, ENU and FLU.
            time: When it was valid, on our clock [s].
            t: The same time counted from the start of the reference [s].
            asked: What was sent lately, as it left.
        """


Say = Callable[[str], None]
Maker = Callable[[Say], FlightController]
"""Makes a controller, in the process that it is to run in, and says what takes long."""


class ControllerError(NsdeError, RuntimeError):
    """A controller cannot be made; the message says why."""


class Runner(ABC):
    """Runs a controller."""

    plan: DemandPlan | None = None  # the newest plan
    fault: str | None = None  # why there will be no more
    ready: bool = False  # whether the controller is made

    @abstractmethod
    def offer(self, row: tuple[float, ...], time: float, t: float, asked: Asked = ()) -> None:
        """A new state (see `FlightController`); it is planned for now, later or not at all."""

    def collect(self) -> None:  # noqa: B027
        """Take what has come."""

    def wait(self) -> None:
        """Until the controller is made, minutes where it is compiled; ControllerError where it cannot be."""
        while not self.ready and self.fault is None:
            time.sleep(0.02)
            self.collect()
        if self.fault is not None:
            raise ControllerError(self.fault)

    def close(self) -> None:  # noqa: B027
        """End it."""

    def _take(self, plan: DemandPlan) -> None:
        """A plan that is not finite is none."""
        if all(finite(*d.w, d.thrust) for d in plan.demands) and plan.demands and plan.dt > 0:
            self.plan = plan


@final
@dataclass(eq=False)
class Inline(Runner):
    """In the loop: for controllers that take microseconds, and for flights in virtual time."""

    controller: FlightController
    _: KW_ONLY
    period: float = 0.0  # shortest time between states that it is given [s]
    delay: float = 0.0  # age of a state at which its plan is taken, to play the time of a solve [s]

    def __post_init__(self) -> None:
        self.ready, self._offered = True, -inf
        self._made = deque[tuple[float, DemandPlan]]()

    def offer(self, row: tuple[float, ...], time: float, t: float, asked: Asked = ()) -> None:
        if self.fault is not None:
            return
        while self._made and time - self._made[0][0] >= self.delay - 1e-3:
            self._take(self._made.popleft()[1])
        if 0.0 <= time - self._offered < self.period - 1e-3:
            return
        self._offered = time
        try:
            plan = self.controller(row, time, t, asked)
            if self.delay > 0.0:
                self._made.append((time, plan))
            else:
                self._take(plan)
        except Exception as error:  # any fault of a controller ends in the safe action, not in a crash
            self.fault = f"{type(error).__name__}: {error}"


@final
@dataclass(eq=False)
class Process(Runner):
    """In a process of its own."""

    maker: Maker  # makes the controller over there; it must be importable by name
    _: KW_ONLY
    period: float = 0.0  # shortest time between states that it is given [s]
    say: Say = lambda line: None  # takes a line about what takes long over there

    def __post_init__(self) -> None:
        self._offered = -inf
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(self.maker, theirs), daemon=True)
        self.process.start()
        theirs.close()
        self._busy = True  # until it says that it is ready

    def offer(self, row: tuple[float, ...], time: float, t: float, asked: Asked = ()) -> None:
        # a state that is a fraction of a millisecond early is not left for the next tick
        if self._busy or self.fault is not None or 0.0 <= time - self._offered < self.period - 1e-3:
            return
        try:
            self._pipe.send((row, time, t, tuple(asked)))
            self._busy, self._offered = True, time
        except (OSError, ValueError):
            self.fault = self.fault or "the controller's process is gone"

    def collect(self) -> None:
        try:
            while self.fault is None and self._pipe.poll():
                answer = self._pipe.recv()
                if isinstance(answer, DemandPlan):
                    self._busy = False
                    self._take(answer)
                elif answer is None:
                    self._busy, self.ready = False, True
                elif isinstance(answer, tuple):  # a line that was said over there
                    self.say(*answer)
                else:
                    self.fault = str(answer)
        except (EOFError, OSError):
            self.fault = "the controller's process is gone"

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._pipe.close()
        self.process.join(0.5)
        if self.process.is_alive():
            self.process.kill()
            self.process.join(1.0)


def _work(maker: Maker, pipe: Connection) -> None:
    # Ctrl-C is the loop's business: it needs plans until it has landed
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(OSError, AttributeError):
        os.nice(1)  # the stream goes first
    try:
        controller = maker(lambda line: pipe.send((line,)))
        pipe.send(None)
        with urgent(PLANS):  # now that it is compiled
            while True:
                row, stamp, t, asked = pipe.recv()
                started = time.perf_counter()
                plan = controller(row, stamp, t, asked)
                took = 1e3 * (time.perf_counter() - started)
                pipe.send(DemandPlan(plan.time, plan.dt, plan.demands, plan.status, plan.solve_ms or took))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
    except NsdeError as error:  # of the user's doing: the message says all
        with contextlib.suppress(OSError):
            pipe.send(str(error))
    except Exception as error:  # said to the loop, which then lands
        lines = traceback.format_exc().strip().splitlines()
        with contextlib.suppress(OSError):
            pipe.send(f"{type(error).__name__}: {error} ({lines[-3].strip() if len(lines) > 2 else ''})")
