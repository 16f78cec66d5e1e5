"""What every phase of a flight can do, and what is done about troubles (see `safety` for which there are)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from math import degrees, inf, pi

from nsde_torch.px4.flight.cascade import Point, SetpointCascade
from nsde_torch.px4.flight.controller import Demand
from nsde_torch.px4.flight.options import FlightOptions
from nsde_torch.px4.flight.path import PathPoints
from nsde_torch.px4.flight.phases import FLYING, REFUSED, FlightOutcome, Phase
from nsde_torch.px4.flight.runner import Runner
from nsde_torch.px4.flight.safety import Action, Limits, Trouble, Watch
from nsde_torch.px4.flight.setpoint import Guard, HoverThrottle, SetpointLimits, level
from nsde_torch.px4.link import dialect as d
from nsde_torch.px4.link.endpoint import Endpoint
from nsde_torch.px4.link.telemetry import Status, VehicleState
from nsde_torch.px4.link.vectors import Vec, distance, yaw_of

STALL = 0.15
"""Time between two ticks from which on this process stood still [s]; what came meanwhile must be heard first."""
GRACE = 0.05
"""Time that the hearing is given for it [s]."""
REMEMBERED = 0.3
"""Time for which a controller is given what was sent [s]."""
SETPOINTS = 500
"""Newest rates that are recognised as ours when PX4 reports them: it may hold them for 2 s, at 250 a second."""


class Supervised(ABC):
    """A flight but for its phases: the stream, the place to hold, and the watch over both.

    Args:
        endpoint: The link's end.
        runner: The controller of the reference.
        path: The reference, from the place of take-off.
        limits: When something is wrong.
        setpoints: Bounds of the commands that are sent.
        options: How the flight goes.
        say: Takes one line about each step.

    Attributes:
        phase: Where we are.
        outcome: How it ended.
        home: Place of take-off [m], once known.
        sent: Time, rates and throttle that left last.
        started: When the reference began, on our clock [s].
        ours_until: Newest time at which the vehicle said that it flies by our setpoints [s].
    """

    def __init__(
        self,
        endpoint: Endpoint,
        runner: Runner,
        path: PathPoints,
        *,
        limits: Limits | None = None,
        setpoints: SetpointLimits | None = None,
        options: FlightOptions | None = None,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.endpoint, self.runner, self.path = endpoint, runner, path
        self.limits, self.options = limits or Limits(), options or FlightOptions()
        self.guard = Guard(setpoints or SetpointLimits())
        self.phase, self.outcome = Phase.CONNECT, FlightOutcome()
        self.home: Vec | None = None
        self.hover = HoverThrottle(0.5)
        self.sent: tuple[float, Vec, float] | None = None
        self._left: deque[tuple[float, Demand]] = deque()
        self._rates: deque[Vec] = deque(maxlen=SETPOINTS)
        self.started: float | None = None
        self.ours_until = -inf
        self.streaming = False
        self._say = say
        self._cascade = SetpointCascade()
        self._watch: Watch | None = None
        self._begun: float | None = None
        self._since = self._asked = self._now = self._last = self._grace = self._arrived = 0.0
        self._good_since: float | None = None
        self._bad_since: float | None = None
        self._where = Point((0.0, 0.0, 0.0))
        self._ground = 0.0
        self._yaw = 0.0
        self._seen: VehicleState | None = None
        self._stop = 0
        self._lifted = False
        self._on_plans = True
        self._waiting = False
        self.reason = ""

    # from outside

    @property
    def done(self) -> bool:
        """Whether the flight is over."""
        return self.phase is Phase.DONE

    def stop(self) -> None:
        """Ctrl-C: hold and land; twice: land at once; thrice: leave."""
        self._stop += 1

    @abstractmethod
    def tick(self, now: float) -> None:
        """Do what is due; call it at the rate of the stream.

        Args:
            now: [s]
        """

    # from phase to phase

    def _go(self, phase: Phase, why: str = "") -> None:
        assert self._begun is not None
        self.phase, self._since, self._asked = phase, self._now, 0.0
        self.outcome.actions.append((self._now - self._begun, phase.value, why))
        self._say(f"{self._now - self._begun:7.2f} s  {phase.value}{': ' + why if why else ''}")

    def _refuse(self, why: str) -> None:
        """End a flight that has not begun."""
        self.streaming = False
        self.outcome.trouble = self.outcome.trouble or Trouble(REFUSED, why, Action.SILENCE)
        self._go(Phase.DONE, why)

    @property
    def _elapsed(self) -> float:
        return self._now - self._since

    def _every(self, period: float) -> bool:
        """Whether something that is repeated is due, at once when a phase begins."""
        if self._asked and self._now - self._asked < period:
            return False
        self._asked = self._now
        return True

    def _texts(self, status: Status) -> str:
        """What the autopilot said since this phase began, warnings and worse first."""
        new = [t for t in status.texts if t.time >= self._since - 0.5]
        bad = [t.text for t in new if t.severity <= 4] or [t.text for t in new]
        return "; ".join(dict.fromkeys(bad)) or "it gave no reason"

    def _finished(self) -> None:
        self.streaming = False
        self.outcome.landed = self.endpoint.telemetry.status.landed != d.IN_AIR
        self._go(Phase.DONE, "disarmed")

    # troubles

    def _supervise(self, state: VehicleState | None, status: Status) -> None:
        """Look for troubles, and act on them."""
        followed = self.endpoint.telemetry.followed
        if self.phase not in FLYING:
            followed.clear()  # what it followed before is not another client's
        if self.phase in (Phase.STREAM, Phase.OFFBOARD, Phase.ARM, Phase.PREFLIGHT, Phase.CONNECT):
            self._supervise_ground(state, status)
            return
        if self.phase not in FLYING:
            return
        assert self._watch is not None
        if not status.armed:
            self._trouble(Trouble("disarmed", f"it is disarmed: {self._texts(status)}", Action.SILENCE))
            self._finished()
            return
        if status.mode != d.OFFBOARD:
            self._hand_back(status)
            return
        trouble = self._watch.look(state, status, self._now)
        trouble = trouble or self._watch.check_setpoints(followed, self._rates, self.ours_until)
        self._follow(self._watch)
        if trouble is None and self._stop:
            trouble = Trouble("stop", "asked to stop", Action.HOLD if self._stop == 1 else Action.LAND)
        if trouble is not None:
            self._act(trouble, state, status)

    def _follow(self, watch: Watch) -> None:
        """Note resets of the estimate; a heading that is held moves with its estimate, so that nothing turns."""
        assert self._begun is not None
        for step in watch.steps:
            self.outcome.steps.append((self._now - self._begun, step))
            self._say(
                f"{self._now - self._begun:7.2f} s  note: the estimate was reset: heading "
                f"{degrees(step.heading):+.1f} deg, position {step.position:.2f} m, velocity {step.velocity:.2f} m/s"
            )
            self._yaw += step.heading
            self._where = replace(self._where, yaw=self._where.yaw + step.heading)
        watch.steps.clear()

    def _supervise_ground(self, state: VehicleState | None, status: Status) -> None:
        """Before the flight every trouble ends it; what may have been armed is disarmed."""
        if self._stop:
            why = "asked to stop"
            self._trouble(Trouble("stop", why, Action.LAND))
        elif self.phase in (Phase.CONNECT, Phase.PREFLIGHT):
            return
        elif self._now - status.heard > self.limits.silence:
            why = f"nothing heard for {self._now - status.heard:.1f} s"
        elif state is None or self._now - state.time > self.limits.estimate:
            why = "the state is too old"
        elif self.phase is Phase.ARM and status.mode != d.OFFBOARD:
            why = f"the operator chose {status.mode}"
        else:
            return
        if self.phase is Phase.ARM:
            self._trouble(Trouble("stopped", why, Action.LAND))
            self._go(Phase.DISARM, why)
        else:
            self._refuse(why)

    def _stood_still(self, status: Status) -> bool:
        """Whether this process stood still just now, so that nothing may be judged or sent yet.

        Setpoints that come back after PX4 has failed over would bring it back to OFFBOARD: then none are sent.
        """
        gap = self._now - self._last
        if self.streaming and gap > STALL and self.phase in (*FLYING, Phase.BLIND, Phase.LAND):
            self._grace = self._now + GRACE
            longest = min(self.limits.silence, status.parameters.get("COM_OF_LOSS_T", inf))
            if gap > longest:
                text = f"this process stood still for {gap:.2f} s: PX4 had no setpoints"
                self._trouble(Trouble("late", text, Action.SILENCE))
                self._silence(text)
        return self._now < self._grace

    def _dead(self, status: Status) -> bool:
        """Whether the link is dead, which ends the waiting for what it would say."""
        silent = self._now - status.heard
        if silent <= self.options.dead:
            return False
        text = f"the link is dead: nothing heard for {silent:.0f} s"
        self._trouble(Trouble("link", text, Action.SILENCE))
        self.streaming = False
        self._go(Phase.DONE, text)
        return True

    def _trouble(self, trouble: Trouble) -> None:
        self.outcome.trouble = self.outcome.trouble or trouble

    def _act(self, trouble: Trouble, state: VehicleState | None, status: Status) -> None:
        """Do what a trouble asks for."""
        self._trouble(trouble)
        if trouble.action is Action.SILENCE:
            self._silence(trouble.text)
        elif trouble.action is Action.BLIND:
            self._go(Phase.BLIND, trouble.text)
        elif not self._lifted:
            self._disarm_or_land(trouble, status)
        elif trouble.action is Action.LAND or state is None:
            if state is not None:
                self._where = self._stop_point(state)
            self._go(Phase.LAND, trouble.text)
        elif self.phase is not Phase.SAFE_HOLD:
            self._where = self._stop_point(state)
            self._cascade.reset()
            self._go(Phase.SAFE_HOLD, trouble.text)

    def _disarm_or_land(self, trouble: Trouble, status: Status) -> None:
        self._trouble(trouble)
        if status.landed == d.ON_GROUND:
            self._go(Phase.DISARM, trouble.text)
        else:
            self._go(Phase.LAND, trouble.text)

    def _hand_back(self, status: Status) -> None:
        """Another mode than ours: whoever chose it has the vehicle."""
        text = f"the mode is {status.mode}, not ours: {self._texts(status)}"
        self._trouble(Trouble("mode", text, Action.SILENCE))
        self._silence(text)

    def _silence(self, why: str) -> None:
        self.streaming = False
        self._go(Phase.WATCH, why)

    # flying

    def _own(self, state: VehicleState) -> tuple[float, ...]:
        """The state in the coordinates of the reference."""
        assert self.home is not None
        row = state.row
        return (row[0] - self.home[0], row[1] - self.home[1], row[2] - self._ground, *row[3:])

    def _moved(self, p: Vec) -> Vec:
        """A point of the reference in the world."""
        assert self.home is not None
        return (p[0] + self.home[0], p[1] + self.home[1], p[2] + self._ground)

    def _stop_point(self, state: VehicleState) -> Point:
        """Where to hold: where it comes to rest from its speed, inside the fence, above the ground."""
        assert self._watch is not None
        ahead = 0.35
        p: Vec = (
            state.p[0] + ahead * state.v[0],
            state.p[1] + ahead * state.v[1],
            max(state.p[2] + 0.2 * state.v[2], self._ground + 0.5),
        )
        return Point(self._watch.inside(p), yaw=yaw_of(state.q))

    def _towards(self, at: Vec, goal: Vec, speed: float) -> Vec:
        """A point that moves to the goal at a speed."""
        left, step = distance(at, goal), speed * max(self._now - self._last, 0.0)
        if left <= step:
            return goal
        k = step / left
        return (at[0] + k * (goal[0] - at[0]), at[1] + k * (goal[1] - at[1]), at[2] + k * (goal[2] - at[2]))

    def _turn_towards(self, yaw: float, goal: float) -> float:
        left = (goal - yaw + pi) % (2.0 * pi) - pi
        step = 0.6 * max(self._now - self._last, 0.0)
        return goal if abs(left) <= step else yaw + (step if left > 0 else -step)

    def _hold_at(self, to: Point, state: VehicleState) -> None:
        """Fly the built-in cascade to a point."""
        self._where = to
        dt = min(max(self._now - self._last, 0.0), 0.05)
        self._send(self._cascade(state.p, state.v, state.q, to, dt), state)

    def _send(self, demand: Demand, state: VehicleState | None) -> None:
        checked = self.guard.check(demand.w, self.hover.throttle(demand.thrust), state)
        if checked is None:
            safe = level(state)
            checked = self.guard.check(safe.w, self.hover.throttle(safe.thrust), state)
            assert checked is not None
        self._leave(*checked)

    def _send_idle(self, throttle: float) -> None:
        self._leave((0.0, 0.0, 0.0), throttle)

    def _leave(self, w: Vec, throttle: float) -> None:
        if not self.streaming:
            return
        self.endpoint.send_rates(w, throttle, self._now)
        self.hover.sent(self._now, throttle)
        self.sent = (self._now, w, throttle)
        self._left.append((self._now, Demand(w, self.hover.thrust(throttle))))
        self._rates.append(w)
        while self._left[0][0] < self._now - REMEMBERED:
            self._left.popleft()
