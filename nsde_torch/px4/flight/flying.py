"""A flight in real time: the loop that streams, and what it measured."""

import contextlib
import gc
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from math import degrees, inf, isfinite
from pathlib import Path
from typing import Any

import numpy as np

from nsde_torch.px4.flight.cascade import PathPoints
from nsde_torch.px4.flight.controller import Runner
from nsde_torch.px4.flight.flight_log import FlightLog
from nsde_torch.px4.flight.offboard import Offboard
from nsde_torch.px4.flight.safety import FLYING, REFUSED, Action, FlightOutcome, Limits, Phase, Trouble
from nsde_torch.px4.link import dialect as d
from nsde_torch.px4.link.connection import STREAM, Connection, urgent, why_no_state
from nsde_torch.px4.link.telemetry import VehicleState
from nsde_torch.px4.link.vectors import Vec, distance, plus
from nsde_torch.px4.options import FlightOptions, SetpointLimits

LOOK = 0.05  # time between looks at the vehicle [s]
STANDS = 1.0  # time on the ground after which PX4 is asked to disarm, and between such requests [s]


def land(
    link: Connection, *, options: FlightOptions | None = None, say: Callable[[str], None] = lambda line: None
) -> FlightOutcome:
    """Ask for LAND until that is confirmed, and wait until the vehicle is disarmed, however long that takes.

    No setpoint is sent. Whoever chooses another mode meanwhile has the vehicle; to disarm is asked for on the ground
    alone, and never by force. Raises nothing: the outcome says whether it landed, or what kept it from that.
    """
    options = options or FlightOptions()
    endpoint, out = link.endpoint, FlightOutcome()
    begun = link.now()

    def go(phase: Phase, why: str) -> None:
        out.actions.append((link.now() - begun, phase.value, why))
        say(f"{link.now() - begun:7.2f} s  {phase.value}: {why}")

    def end(kind: str, why: str) -> FlightOutcome:
        out.trouble = Trouble(kind, why, Action.SILENCE)
        go(Phase.DONE, why)
        return out

    while endpoint.status().heartbeat == -inf:
        if link.now() - begun > options.connect:
            return end(REFUSED, why_no_state(endpoint, options.connect))
        link.pause(LOOK)
    found = endpoint.status()
    if not found.armed:
        return end(REFUSED, "the vehicle is disarmed: nothing is in the air")
    go(Phase.LAND, f"the mode was {found.mode}")
    since, asked, confirmed, stood = link.now(), -inf, False, link.now()
    while (status := endpoint.status()).armed or status.heartbeat < since:
        now = link.now()
        confirmed = confirmed or (status.mode == d.LAND and status.heartbeat >= since)
        if now - status.heard > options.dead:
            return end("link", f"the link is dead: nothing heard for {now - status.heard:.0f} s")
        if confirmed and status.mode != d.LAND:
            return end("mode", f"the mode is {status.mode}: whoever chose it has the vehicle")
        if not confirmed and now - since > options.confirm:
            said = "; ".join(dict.fromkeys(t.text for t in status.texts if t.time >= since))
            why = f"LAND was not confirmed, the mode is {status.mode}: {said or 'it gave no reason'}"
            return end("mode", f"{why}. Land it with the sticks")
        if status.landed != d.ON_GROUND:
            stood = now
        if not confirmed and now - asked > 0.5:
            asked = now
            endpoint.ask_mode(d.LAND)
        elif confirmed and now - max(stood, asked) > STANDS:
            asked = now
            endpoint.command(d.ARM, 0.0)
        link.pause(LOOK)
    out.landed = status.landed != d.IN_AIR
    go(Phase.DONE, "disarmed")
    return out


RATE = 100.0  # ticks of the loop in a second; each sends a setpoint
LOGGED_FROM = 0.3  # height above which a flight is logged [m]: below, the ground acts on it


@dataclass
class FlightReport:
    """What a flight measured."""

    outcome: FlightOutcome  # how it ended
    errors: list[float] = field(default_factory=list)  # distance from the reference while it was tracked [m]
    track: list[tuple[float, ...]] = field(default_factory=list)
    """Time in the reference [s] and state from the place of take-off, in rows, while it was tracked."""
    gaps: list[float] = field(default_factory=list)  # times between setpoints [s]
    ages: list[float] = field(default_factory=list)  # age of the state at each setpoint [s]
    solves: list[float] = field(default_factory=list)  # times of the controller [ms]
    statuses: dict[str, int] = field(default_factory=dict)  # what it said of its plans
    bounded: dict[str, int] = field(default_factory=dict)  # how often what was bounded in setpoints
    hover: float = 0.0  # throttle that hovers, as learned
    log: Path | None = None  # the log, None where nothing was flown
    link: dict[str, int] = field(default_factory=dict)  # what became of frames
    texts: list[str] = field(default_factory=list)
    drift: float = 0.0  # seconds that its clock gains in one of ours
    quality: dict[str, float] = field(default_factory=dict)
    """The worst that the vehicle's estimator said of itself in flight, by the names of `EstimateQuality`."""

    @property
    def rmse(self) -> float | None:
        """Of the position while the reference was tracked [m]."""
        return float(np.sqrt(np.mean(np.square(self.errors)))) if self.errors else None

    def as_dict(self) -> dict[str, Any]:
        """Numbers with units in their keys."""
        o = self.outcome
        return {
            "tracked": o.tracked,
            "landed": o.landed,
            "trouble": None if o.trouble is None else {"kind": o.trouble.kind, "text": o.trouble.text},
            "phases": [{"t_s": round(t, 3), "phase": p, "reason": why} for t, p, why in o.actions],
            "estimate_resets": [
                {"t_s": round(t, 3), "heading_deg": degrees(s.heading), "position_m": s.position}
                | {"velocity_m_s": s.velocity, "announced": s.announced}
                for t, s in o.steps
            ],
            "without_plans_s": o.without_plans,
            "rmse_m": self.rmse,
            "position_error_max_m": max(self.errors, default=None),
            "estimator_worst": self.quality,
            "setpoint_gap_ms": _spread([1e3 * g for g in self.gaps]),
            "state_age_ms": _spread([1e3 * a for a in self.ages]),
            "clock_drift": self.drift,
            "solve_ms": _spread(self.solves),
            "status": self.statuses,
            "bounded": self.bounded,
            "hover_throttle": self.hover,
            "frames": self.link,
            "texts": self.texts,
        }


def _spread(values: list[float]) -> dict[str, float] | None:
    found = {f"p{p:g}": float(np.percentile(values, p)) for p in (50.0, 99.0, 99.9) if values}
    return {**found, "max": float(max(values)), "count": len(values)} if values else None


class Recorder:
    """Looks at a flight at every tick.

    What counts and what is logged is flown by us: states wait until a heartbeat that came after them says so.
    """

    def __init__(self, flight: Offboard, log: FlightLog | None) -> None:
        self._flight, self._log = flight, log
        self.report = FlightReport(flight.outcome)
        self._sent, self._plan, self._streamed = -1.0, None, False
        self._looked: VehicleState | None = None
        self._flown: deque[tuple[VehicleState, tuple[Any, ...], bool]] = deque()

    def look(self, now: float) -> None:
        """After a tick at `now` [s]."""
        f = self._flight
        state, status = f.endpoint.state, f.endpoint.telemetry.status
        self._look_at_setpoints(now, state)
        plan = f.runner.plan
        if plan is not None and plan is not self._plan and f.phase is Phase.TRACK:
            self._plan = plan  # type: ignore[assignment]
            self.report.solves.append(plan.solve_ms)
            self.report.statuses[plan.status] = self.report.statuses.get(plan.status, 0) + 1
        if state is None or f.home is None:
            return
        new = self._new_states()
        if f.phase in FLYING:
            worst = self.report.quality
            for name, value in vars(status.quality).items() if status.quality else ():
                if name != "time" and isfinite(value):
                    worst[name] = max(worst.get(name, value), value)
            known = (status.motors, status.voltage, f.sent)
            self._flown += [(one, known, f.phase is Phase.TRACK) for one in new]
        while self._flown and self._flown[0][0].received <= f.ours_until:
            self._take(*self._flown.popleft(), f.home)

    def _look_at_setpoints(self, now: float, state: VehicleState | None) -> None:
        f = self._flight
        flying = f.phase in FLYING
        if f.sent is not None and f.sent[0] != self._sent:
            if flying and self._sent >= 0:
                self.report.gaps.append(f.sent[0] - self._sent)
                if state is not None:
                    self.report.ages.append(now - state.time)
            self._sent = f.sent[0]
        elif self._streamed and not (flying and f.streaming):
            # the last one was not closed by a setpoint, however long it was
            self.report.gaps.append(now - self._sent)
        self._streamed = flying and f.streaming

    def _take(self, state: VehicleState, known: tuple[Any, ...], tracked: bool, home: Vec) -> None:
        """A state that is known to be ours: into the statistics while the reference was tracked, and into the log."""
        f = self._flight
        # PX4 counts from where it was switched on; fences and plans count from the place of take-off
        at = plus(state.p, home, -1.0)
        if self._log is not None and at[2] > LOGGED_FROM:
            self._log.add(replace(state, p=at), *known)
        if not tracked:
            return
        # at the time for which the state is valid
        t = state.time - f.started
        self.report.errors.append(distance(at, f.path.at(t).p))
        if not self.report.track or t > self.report.track[-1][0]:
            self.report.track.append((t, *at, *state.row[3:]))

    def _new_states(self) -> list[VehicleState]:
        """States that came since the last tick; there may be several where the machine is busy."""
        found: list[VehicleState] = []
        with self._flight.endpoint.lock:
            for state in reversed(self._flight.endpoint.telemetry.history):
                if state is self._looked:
                    break
                found.append(state)
        if found:
            self._looked = found[0]
        # what came before the flight, or long ago, has other setpoints than the present ones
        return [state for state in reversed(found) if found[0].received - state.received < 0.1]

    def finish(self) -> FlightReport:
        f, r = self._flight, self.report
        r.bounded, r.hover = dict(f.guard.counts), f.hover.value
        r.link = dict(f.endpoint.codec.counts)
        r.drift = f.endpoint.telemetry.sync.drift
        r.texts = [t.text for t in f.endpoint.status().texts]
        if self._log is not None and self._log.rows:
            r.log = self._log.file
        return r


def fly(
    link: Connection,
    runner: Runner,
    path: PathPoints,
    *,
    motors: int,
    log: Path | None = None,
    limits: Limits | None = None,
    setpoints: SetpointLimits | None = None,
    options: FlightOptions | None = None,
    say: Callable[[str], None] = lambda line: None,
    rate: float = RATE,
    watch: Callable[[Offboard, float], None] | None = None,
) -> FlightReport:
    """Fly a path from the place of take-off once, from the ground to the ground.

    Args:
        motors: Number of motors, for the log.
        limits, setpoints, options: See `Limits`, `SetpointLimits` and `FlightOptions`.
        rate: Setpoints in a second.
        watch: Called after every tick, for tests and pictures.

    Returns:
        What was measured. A flight that went wrong raises nothing: see its outcome.
    """
    flight = Offboard(
        link.endpoint,
        runner,
        path,
        limits=limits or Limits(),
        setpoints=setpoints or SetpointLimits(),
        options=options or FlightOptions(),
        say=say,
    )
    with contextlib.ExitStack() as stack:
        book = None if log is None else stack.enter_context(FlightLog(log, motors))
        recorder = Recorder(flight, book)
        stack.enter_context(_undisturbed())
        if link.live:
            stack.enter_context(_signals(flight.stop))
            if not stack.enter_context(urgent(STREAM)):
                say(
                    "           note: no real-time priority: a busy computer delays setpoints. `ulimit -r 2` allows it"
                )
        try:
            due = link.now()
            while not flight.done:
                now = link.now()
                flight.tick(now)
                recorder.look(now)
                if watch is not None:
                    watch(flight, now)
                due = max(due + 1.0 / rate, now)  # ticks that were missed are not made up for
                wait = due - link.now()
                if wait > 0:
                    link.pause(wait)
        except BaseException:
            # whatever it was: the last thing that PX4 hears from us is to land, and no more rates
            flight.streaming = False
            with contextlib.suppress(Exception):
                for _ in range(3):
                    link.endpoint.ask_mode(d.LAND)
            raise
    return recorder.finish()


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """Threads change quickly, and what was there before the flight is not searched for garbage."""
    before = sys.getswitchinterval()
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(0.001)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
        gc.unfreeze()


@contextlib.contextmanager
def _signals(stop: Callable[[], None]) -> Iterator[None]:
    """Ctrl-C and SIGTERM ask the flight to end, instead of ending the program in the air."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {s: signal.signal(s, lambda number, frame: stop()) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
