"""The flight as a state machine: each step is requested, and counts as done when telemetry shows it.

    CONNECT -> PREFLIGHT -> STREAM -> OFFBOARD -> ARM -> TAKEOFF -> HOLD -> TRACK -> RETURN -> LAND -> DISARM -> DONE

Any trouble leads by its action (see `safety`) to SAFE_HOLD, LAND, BLIND or WATCH. In WATCH nothing is streamed, ever
again: the vehicle is the operator's or PX4's. Landing is PX4's own LAND mode, which needs nothing from us.
"""

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field, replace
from math import cos, degrees, inf, pi
from typing import final

from nsde_torch.px4.flight import preflight
from nsde_torch.px4.flight.cascade import GRAVITY, LEAD, PathPoints, Point, SetpointCascade, levelling
from nsde_torch.px4.flight.controller import Demand, DemandPlan, Runner
from nsde_torch.px4.flight.safety import FLYING, REFUSED, Action, FlightOutcome, Limits, Phase, Trouble, Watch
from nsde_torch.px4.link import dialect as d
from nsde_torch.px4.link.connection import why_no_state
from nsde_torch.px4.link.endpoint import Endpoint
from nsde_torch.px4.link.telemetry import Status, VehicleState
from nsde_torch.px4.link.vectors import (
    Vec,
    between,
    bounded,
    cos_tilt,
    distance,
    finite,
    length,
    plus,
    rotate_back,
    tilt_of,
    yaw_of,
)
from nsde_torch.px4.options import FlightOptions, SetpointLimits

# What a demand must pass before it leaves, because PX4 does not check it, and the throttle for a thrust.
#
#     throttle = hover * thrust / g,       hover' = hover + (hover_seen - hover) dt / T,    hover_seen = throttle g / f
#
# with f the specific force along the body's z axis that the velocity showed, over windows of 0.2 s, and the throttle as
# it was a motor's lag before.

LAG, WINDOW, LEARNING = 0.07, 0.2, 1.5
"""From throttle to thrust, the window that the velocity is looked at over, and time constant of learning [s]."""
LOWEST, HIGHEST = 0.08, 0.85  # throttles that are accepted as one that hovers


@final
class Guard:
    """Checks demands; `counts` says how often what was bounded."""

    def __init__(self, limits: SetpointLimits) -> None:
        self.limits = limits
        self.counts: Counter[str] = Counter()

    def check(self, w: Vec, throttle: float, state: VehicleState | None) -> tuple[Vec, float] | None:
        """Rates and throttle as they may leave; None where they are not finite."""
        if not finite(*w, throttle):
            self.counts["not finite"] += 1
            return None
        m = self.limits
        x, y, _ = bounded(w, m.rate)
        z = min(max(w[2], -m.yaw_rate), m.yaw_rate)
        if (x, y, z) != w:
            self.counts["rate"] += 1
        low, high = m.throttle
        within = min(max(throttle, low), high)
        if within != throttle:
            self.counts["throttle"] += 1
        if state is not None and cos_tilt(state.q) < cos(m.tilt):
            self.counts["tilt"] += 1
            x, y, _ = bounded(levelling(state.q), m.rate)
        return (x, y, z), within


@final
class HoverThrottle:
    """Learns the throttle that carries the vehicle, in flight; `first` is the autopilot's own idea (MPC_THR_HOVER)."""

    def __init__(self, first: float) -> None:
        self.value = first
        self._sent: deque[tuple[float, float]] = deque()
        self._states: deque[VehicleState] = deque()

    def throttle(self, thrust: float) -> float:
        """Throttle for a thrust over mass [m/s2]."""
        return self.value * thrust / GRAVITY

    def thrust(self, throttle: float) -> float:
        """The inverse."""
        return throttle * GRAVITY / self.value

    def sent(self, time: float, throttle: float) -> None:
        """A throttle left at a time [s]."""
        self._sent.append((time, throttle))
        while self._sent and self._sent[0][0] < time - 1.0:
            self._sent.popleft()

    def seen(self, state: VehicleState, *, learn: bool) -> None:
        """A state came; `learn` only in the air, away from the ground."""
        self._states.append(state)
        while self._states and self._states[0].time < state.time - WINDOW - 0.02:
            self._states.popleft()
        first = self._states[0]
        span = state.time - first.time
        if not learn or span < 0.8 * WINDOW:
            return
        used = [u for t, u in self._sent if first.time - LAG <= t <= state.time - LAG]
        if tilt_of(state.q) > 35.0 or len(used) < 5:
            return
        a = tuple((n - o) / span for n, o in zip(state.v, first.v, strict=True))
        force = rotate_back(state.q, (a[0], a[1], a[2] + GRAVITY))[2]
        if force < 0.4 * GRAVITY:
            return
        wanted = sum(used) / len(used) * GRAVITY / force
        # states come far more often than windows end; each counts for its own share of the time
        share = min((state.time - self._states[-2].time) / LEARNING, 0.1)
        self.value = min(max(self.value + share * (wanted - self.value), LOWEST), HIGHEST)


def level(state: VehicleState | None, thrust: float = GRAVITY) -> Demand:
    """The demand that levels the vehicle, or without an attitude keeps it from turning."""
    return Demand(levelling(state.q) if state is not None else (0.0, 0.0, 0.0), thrust)


REST, SETTLE = 1.0, 4.0
"""Time of rest after the reference, and longest wait for it above the place of take-off [s]."""
STALL = 0.15
"""Time between two ticks from which on this process stood still [s]; what came meanwhile must be heard first."""
GRACE = 0.05  # time that the hearing is given for it [s]
REMEMBERED = 0.3  # time for which a controller is given what was sent [s]
SETPOINTS = 500
"""Newest rates that are recognised as ours when PX4 reports them: it may hold them for 2 s, at 250 a second."""


@final
@dataclass(eq=False)
class Offboard:
    """One flight: its phases, the stream, the place to hold, and the watch over all of them."""

    endpoint: Endpoint  # the link's end
    runner: Runner  # the controller of the reference
    path: PathPoints  # the reference, from the place of take-off
    _: KW_ONLY
    limits: Limits = field(default_factory=Limits)
    setpoints: SetpointLimits = field(default_factory=SetpointLimits)
    options: FlightOptions = field(default_factory=FlightOptions)
    say: Callable[[str], None] = lambda line: None  # takes one line about each step

    def __post_init__(self) -> None:
        self.guard = Guard(self.setpoints)
        self.phase, self.outcome = Phase.CONNECT, FlightOutcome()
        self.home: Vec | None = None  # place of take-off [m], once known
        self.hover = HoverThrottle(0.5)
        self.sent: tuple[float, Vec, float] | None = None  # time, rates and throttle that left last
        self._left: deque[tuple[float, Demand]] = deque()
        self._rates: deque[Vec] = deque(maxlen=SETPOINTS)
        self.started = -inf  # when the reference began, on our clock [s]
        self.ours_until = -inf  # newest time at which the vehicle said that it flies by our setpoints [s]
        self.streaming = False
        self._cascade = SetpointCascade()
        self._watch = Watch(self.limits, (0.0, 0.0, 0.0))  # another one, once the place of take-off is known
        self._begun = inf  # until the first tick
        self._since = self._asked = self._now = self._last = self._grace = self._arrived = 0.0
        self._fit: bool | None = None  # to fly, and since when
        self._fit_since = 0.0
        self._where = Point((0.0, 0.0, 0.0))
        self._ground = self._yaw = 0.0
        self._seen: VehicleState | None = None
        self._stop, self._lifted, self._on_plans = 0, False, True

    # from outside

    @property
    def done(self) -> bool:
        return self.phase is Phase.DONE

    def stop(self) -> None:
        """Ctrl-C: hold and land; twice: land at once; thrice: leave."""
        self._stop += 1

    def tick(self, now: float) -> None:
        """Do what is due at a time [s]; call it at the rate of the stream."""
        if self._begun == inf:
            self._begun = self._since = self._last = now
        self._now = now
        state, status = self.endpoint.state, self.endpoint.telemetry.status
        if state is not None and state is not self._seen:
            self._seen = state
            in_air = self.phase in FLYING and self._lifted and state.p[2] > self._ground + 0.4
            self.hover.seen(state, learn=in_air and self.streaming)
        if status.mode == d.OFFBOARD and status.armed:
            self.ours_until = status.heartbeat
        if not self._stood_still(status):
            self._supervise(state, status)
            if not self.done:
                getattr(self, f"_in_{self.phase.name.lower()}")(state, status)
        self._last = now

    # from phase to phase

    def _go(self, phase: Phase, why: str = "") -> None:
        self.phase, self._since, self._asked = phase, self._now, 0.0
        self.outcome.actions.append((self._now - self._begun, phase.value, why))
        self.say(f"{self._now - self._begun:7.2f} s  {phase.value}{': ' + why if why else ''}")

    def _refuse(self, why: str) -> None:
        """End a flight that has not begun."""
        self._give_up(REFUSED, why, Phase.DONE)

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
        self.outcome.landed = self.endpoint.telemetry.status.landed != d.IN_AIR
        self._silence("disarmed", Phase.DONE)

    # phases, one method each, named like it; those in which we fly have a state, or `_supervise` would have ended them

    def _in_connect(self, state: VehicleState | None, status: Status) -> None:
        if state is not None and status.heartbeat > -inf:
            self._go(Phase.PREFLIGHT)
        elif self._elapsed > self.options.connect:
            self._refuse(why_no_state(self.endpoint, self.options.connect))

    def _in_preflight(self, state: VehicleState | None, status: Status) -> None:
        if self._every(0.3):
            for name in (*preflight.PARAMETERS, *preflight.OPTIONAL):
                if name not in status.parameters:
                    self.endpoint.ask_parameter(name)
            if self.options.takeover:
                self.endpoint.ask_home()
        found = preflight.faults(
            self.endpoint, status, state, self.path, self.limits, options=self.options, now=self._now
        )
        if self._fit is not (not found):
            self._fit, self._fit_since = not found, self._now
        lasted = self._now - self._fit_since
        if found:
            if lasted > self.options.checks:
                self._list(found, status)
                self._refuse("not fit to fly: " + "; ".join(found))
            return
        known = all(name in status.parameters for name in preflight.PARAMETERS)
        settled = lasted >= 1.0 and (known or self._elapsed > 3.0)
        if not settled:
            return
        self.runner.collect()
        if self.runner.fault is not None:
            self._refuse(f"the controller failed: {self.runner.fault}")
            return
        if not self.runner.ready:
            return
        self._list([], status)
        if self.options.only_check:
            self._go(Phase.DONE, "checked: fit to fly")
            return
        assert state is not None
        home = status.home if self.options.takeover else None
        self._lifted = home is not None
        self.home = state.p if home is None else home
        self._ground, self._yaw = self.home[2], yaw_of(state.q)
        self._watch = Watch(self.limits, self.home)
        hover = status.parameters.get("MPC_THR_HOVER", 0.5)
        self.hover = HoverThrottle(min(max(hover, 0.1), 0.8))
        self._go(Phase.STREAM)

    def _list(self, faults: list[str], status: Status) -> None:
        """Say all that is wrong, a line each, with what mends it."""
        for line in faults:
            self.say(f"           refused: {line}")
        for line in preflight.warnings(self.endpoint, status, self.path, self.limits):
            self.say(f"           note: {line}")

    def _in_stream(self, state: VehicleState, status: Status) -> None:
        self.streaming = True
        self._send_first(state)
        if self._elapsed > self.options.idle:
            self._go(Phase.OFFBOARD)

    def _send_first(self, state: VehicleState) -> None:
        """What PX4 follows when it enters OFFBOARD: nothing on the ground, in the air to stay where it is."""
        if not self._lifted:
            self._send_idle(0.0)
            return
        self._cascade.reset()
        self._hold_at(Point(state.p, yaw=yaw_of(state.q)), state)

    def _in_offboard(self, state: VehicleState, status: Status) -> None:
        self._send_first(state)
        if status.mode == d.OFFBOARD:
            self._go(Phase.HOLD if self._lifted else Phase.ARM)
        elif self._lifted and status.mode != d.HOLD:
            self._refuse(f"the operator chose {status.mode}")
        elif self._elapsed > self.options.confirm:
            self._refuse(f"OFFBOARD was refused, the mode is {status.mode}: {self._texts(status)}")
        elif self._every(1.0):
            self.endpoint.ask_mode(d.OFFBOARD)

    def _in_arm(self, state: VehicleState | None, status: Status) -> None:
        self._send_idle(0.0)
        if status.armed:
            self._cascade.reset()
            self._go(Phase.TAKEOFF)
        elif self._elapsed > self.options.confirm:
            self._refuse(f"arming was refused: {self._texts(status)}")
        elif self._every(1.0):
            self.endpoint.command(d.ARM, 1.0)

    def _in_takeoff(self, state: VehicleState, status: Status) -> None:
        o = self.options
        rise = self._elapsed - o.spool
        if rise < 0:
            self._send_idle(0.4 * self.hover.value * self._elapsed / o.spool)
            return
        # past the height at which PX4 resets its heading, where the fence has room for it
        highest = self.limits.fence[2][1] - preflight.climb_room(o)
        top = self._ground + max(o.height, min(o.climb_past, highest))
        z = min(self._ground + o.climb * rise, top)
        if not self._lifted:
            # the wanted height does not run away from a vehicle that still stands
            z = min(z, self._ground + 0.4)
            if state.p[2] > self._ground + 0.1:
                self._lifted = True
                self._since = self._now - o.spool - (state.p[2] - self._ground) / o.climb
            elif rise > o.lift:
                self._act(Trouble("lift", "it does not lift off", Action.LAND), state, status)
                return
        speed, (x, y, _) = o.climb if z < top else 0.0, self._watch.home
        self._hold_at(Point((x, y, z), (0.0, 0.0, speed), yaw=self._yaw), state)
        if self._lifted and abs(state.p[2] - top) < 0.15 and length(state.v) < 0.4 and z >= top:
            self._go(Phase.HOLD)

    def _in_hold(self, state: VehicleState, status: Status) -> None:
        """Hover, go to the start of the reference, and wait until the controller plans."""
        start = self.path.at(0.0)
        goal = self._moved(start.p)
        if self._elapsed < self.options.hold:
            at, yaw = self._where.p, self._where.yaw
        else:
            at = self._towards(self._where.p, goal, self.options.approach)
            yaw = self._turn_towards(self._where.yaw, start.yaw)
        self._hold_at(Point(at, yaw=yaw), state)
        # integrals and the like of the controller should not grow on the way
        if distance(state.p, goal) < 0.5:
            self.runner.offer(self._own(state), state.time, 0.0, tuple(self._left))
        self.runner.collect()
        ready = self.runner.plan is not None and self._now - self.runner.plan.time < self.limits.solver
        there = distance(state.p, goal) < 0.25 and length(state.v) < 0.3 and at == goal and yaw == start.yaw
        if self._elapsed > self.options.hold + 1.0 and there and ready:
            self.started = self._now
            self._go(Phase.TRACK, self.path.name)
        elif self._elapsed > self.options.hold + 60.0:
            kind, text = "start", "the start of the reference is not reached"
            if not ready:
                kind, text = "solver", "the controller does not plan in time"
            self._act(Trouble(kind, text, Action.HOLD), state, status)

    def _in_track(self, state: VehicleState, status: Status) -> None:
        t = state.time - self.started
        self.runner.offer(self._own(state), state.time, t, tuple(self._left))
        self.runner.collect()
        plan = self.runner.plan
        assert plan is not None  # the reference begins with one
        trouble = self._tracking_trouble(plan, state, t)
        if trouble is not None:
            self._act(trouble, state, status)
        elif self._now - self.started > self.path.duration + 0.5:
            self.outcome.tracked = True
            self._where = self._stop_point(state)
            self._go(Phase.RETURN)
        elif self._late(plan):
            self._follow_without_plans(state, t)
            return
        else:
            self._on_plans = True
            self._send(plan.at(self._now), state)
            return
        self._hold_at(self._where, state)

    def _late(self, plan: DemandPlan) -> bool:
        return self._now - plan.time > self.limits.solver

    def _follow_without_plans(self, state: VehicleState, t: float) -> None:
        """Fly the reference by the built-in cascade at a time in it [s], until plans come again."""
        if self._on_plans:
            self._on_plans = False
            self._cascade.reset()
            self.say(
                f"           note: plans are late at {t:.1f} s; the built-in cascade flies the reference"
            )
        self.outcome.without_plans += max(self._now - self._last, 0.0)
        to = self.path.led(t, LEAD)
        self._hold_at(replace(to, p=self._moved(to.p)), state)

    def _tracking_trouble(self, plan: DemandPlan, state: VehicleState, t: float) -> Trouble | None:
        """Why the controller may not fly on, with the state of a time in the reference [s]."""
        if self.runner.fault is not None:
            return Trouble("solver", f"the controller failed: {self.runner.fault}", Action.HOLD)
        if self._late(plan) and self.outcome.without_plans > self.limits.without_plans:
            text = f"plans were older than {self.limits.solver:g} s for {self.outcome.without_plans:.1f} s in all"
            return Trouble("solver", text, Action.HOLD)
        if "failed" in plan.status:
            return Trouble("solver", f"the controller says: {plan.status}", Action.HOLD)
        off = distance(state.p, self._moved(self.path.at(t).p))
        return self._watch.track(off, plan, self._now)

    def _in_return(self, state: VehicleState, status: Status) -> None:
        """Come to rest, and where that is asked for fly back: the next flight then has the same place and fence."""
        at = goal = self._where.p
        if self.options.come_back:
            goal = self._watch.inside((*self._watch.home[:2], self._ground + self.options.height))
        if self._elapsed > REST:
            at = self._towards(at, goal, self.options.approach)
        if at != goal or self._elapsed <= REST:
            self._arrived = self._now
        self._hold_at(Point(at, yaw=self._where.yaw), state)
        if self._now > self._arrived and (length(state.v) < 0.4 or self._now - self._arrived > SETTLE):
            self._go(Phase.LAND)

    def _in_safe_hold(self, state: VehicleState, status: Status) -> None:
        self._hold_at(self._where, state)
        if self._elapsed > self.options.safe_hold:
            self._go(Phase.LAND)

    def _in_blind(self, state: VehicleState | None, status: Status) -> None:
        """No believable state: keep level by what is known, ask PX4 to land, and end the stream soon."""
        if self._every(0.2):
            self.endpoint.ask_mode(d.LAND)
        if status.mode == d.LAND:
            self.streaming = False
            self._go(Phase.LAND, "confirmed")
        elif self._elapsed > 1.2:
            self._silence("LAND was not confirmed")
        else:
            fresh = state is not None and self._now - state.time < 0.5
            self._send(level(state if fresh else None, 0.97 * GRAVITY), state if fresh else None)

    def _in_land(self, state: VehicleState | None, status: Status) -> None:
        if status.mode != d.LAND:
            if not self.streaming:
                self._silence(f"the mode is {status.mode}")
                return
            if status.mode != d.OFFBOARD:
                self._hand_back(status)
                return
            if self._every(0.5):
                self.endpoint.ask_mode(d.LAND)
            if self._elapsed > self.options.confirm or self._now - status.heard > self.limits.silence:
                self._silence(f"LAND was not confirmed: {self._texts(status)}")
            elif state is not None and self._now - state.time <= self.limits.estimate:
                self._hold_at(self._where, state)
            else:
                self._send(level(None, 0.97 * GRAVITY), None)
            return
        self.streaming = False
        if self._dead(status):
            return
        if not status.armed:
            self._finished()
        elif status.landed == d.ON_GROUND and self._elapsed > 1.0:
            self._go(Phase.DISARM)
        elif self._elapsed > self.options.landing:
            self._silence("the landing is not confirmed")

    def _in_disarm(self, state: VehicleState | None, status: Status) -> None:
        if self.streaming:
            self._send_idle(0.0)
        if self._dead(status):
            return
        if not status.armed:
            self._finished()
        elif self._elapsed > self.options.confirm:
            self._silence(f"disarming was refused: {self._texts(status)}")
        elif self._every(1.0):
            self.endpoint.command(d.ARM, 0.0)

    def _in_watch(self, state: VehicleState | None, status: Status) -> None:
        """Nothing is streamed; if the link lives and the vehicle is still ours by name, PX4 is asked to land it."""
        heard = self._now - status.heard < self.limits.silence
        if self._dead(status):
            return
        if heard and status.heartbeat > self._since and not status.armed:
            self._finished()
        elif self._elapsed > self.options.watch or self._stop > 1:
            self._go(Phase.DONE, "no longer watched")
        elif heard and status.mode == d.OFFBOARD and self._every(1.0):
            self.endpoint.ask_mode(d.LAND)

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
        if not status.armed:
            self._trouble(Trouble("disarmed", f"it is disarmed: {self._texts(status)}", Action.SILENCE))
            self._finished()
            return
        if status.mode != d.OFFBOARD:
            self._hand_back(status)
            return
        trouble = self._watch.look(state, status, self._now)
        trouble = trouble or self._watch.check_setpoints(followed, self._rates, self.ours_until)
        self._note_resets()
        if trouble is None and self._stop:
            trouble = Trouble("stop", "asked to stop", Action.HOLD if self._stop == 1 else Action.LAND)
        if trouble is not None:
            self._act(trouble, state, status)

    def _note_resets(self) -> None:
        """Note resets of the estimate; a heading that is held moves with its estimate, so that nothing turns."""
        for step in self._watch.steps:
            self.outcome.steps.append((self._now - self._begun, step))
            self.say(
                f"{self._now - self._begun:7.2f} s  note: the estimate was reset: heading "
                f"{degrees(step.heading):+.1f} deg, position {step.position:.2f} m, velocity {step.velocity:.2f} m/s"
            )
            self._yaw += step.heading
            self._where = replace(self._where, yaw=self._where.yaw + step.heading)
        self._watch.steps.clear()

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
                self._give_up("late", f"this process stood still for {gap:.2f} s: PX4 had no setpoints")
        return self._now < self._grace

    def _dead(self, status: Status) -> bool:
        """Whether the link is dead, which ends the waiting for what it would say."""
        silent = self._now - status.heard
        if silent <= self.options.dead:
            return False
        text = f"the link is dead: nothing heard for {silent:.0f} s"
        self._give_up("link", text, Phase.DONE)
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
            self._go(Phase.DISARM if status.landed == d.ON_GROUND else Phase.LAND, trouble.text)
        elif trouble.action is Action.LAND or self.phase is not Phase.SAFE_HOLD:
            assert state is not None  # or the trouble would be another one
            self._where = self._stop_point(state)
            if trouble.action is Action.HOLD:
                self._cascade.reset()
            self._go(Phase.LAND if trouble.action is Action.LAND else Phase.SAFE_HOLD, trouble.text)

    def _hand_back(self, status: Status) -> None:
        """Another mode than ours: whoever chose it has the vehicle."""
        self._give_up("mode", f"the mode is {status.mode}, not ours: {self._texts(status)}")

    def _give_up(self, kind: str, why: str, then: Phase = Phase.WATCH) -> None:
        self._trouble(Trouble(kind, why, Action.SILENCE))
        self._silence(why, then)

    def _silence(self, why: str, then: Phase = Phase.WATCH) -> None:
        self.streaming = False
        self._go(then, why)

    # flying

    def _own(self, state: VehicleState) -> tuple[float, ...]:
        """The state in the coordinates of the reference."""
        return (*plus(state.p, self._watch.home, -1.0), *state.row[3:])

    def _moved(self, p: Vec) -> Vec:
        """A point of the reference in the world."""
        return plus(p, self._watch.home)

    def _stop_point(self, state: VehicleState) -> Point:
        """Where to hold: where it comes to rest from its speed, inside the fence, above the ground."""
        (x, y, z), (vx, vy, vz) = state.p, state.v
        p = (x + 0.35 * vx, y + 0.35 * vy, max(z + 0.2 * vz, self._ground + 0.5))
        return Point(self._watch.inside(p), yaw=yaw_of(state.q))

    def _towards(self, at: Vec, goal: Vec, speed: float) -> Vec:
        """A point that moves to the goal at a speed."""
        left, step = distance(at, goal), speed * max(self._now - self._last, 0.0)
        return goal if left <= step else between(at, goal, step / left)

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
