"""The flight as a state machine: each step is requested, and counts as done when telemetry shows it.

    CONNECT -> PREFLIGHT -> STREAM -> OFFBOARD -> ARM -> TAKEOFF -> HOLD -> TRACK -> RETURN -> LAND -> DISARM -> DONE

Any trouble leads by its action (see `safety`) to SAFE_HOLD, LAND, BLIND or WATCH. In WATCH nothing is streamed, ever
again: the vehicle is the operator's or PX4's. Landing is PX4's own LAND mode, which needs nothing from us.
"""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import final

from nsde_torch.px4.flight import failsafe, preflight
from nsde_torch.px4.flight.cascade import GRAVITY, Point
from nsde_torch.px4.flight.controller import DemandPlan
from nsde_torch.px4.flight.path import LEAD
from nsde_torch.px4.flight.phases import FLYING, Phase
from nsde_torch.px4.flight.safety import Action, Trouble, Watch
from nsde_torch.px4.flight.setpoint import HoverThrottle, level
from nsde_torch.px4.flight.supervised import Supervised
from nsde_torch.px4.link import dialect as d
from nsde_torch.px4.link.connection import why_no_state
from nsde_torch.px4.link.telemetry import Status, VehicleState
from nsde_torch.px4.link.vectors import distance, length, yaw_of

REST, SETTLE = 1.0, 4.0
"""Time of rest after the reference, and longest wait for it above the place of take-off [s]."""


@final
class Offboard(Supervised):
    """One flight; see `Supervised` for what it takes and shows."""

    def tick(self, now: float) -> None:
        if self._begun is None:
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
            self._step(state, status)
        self._last = now

    def _step(self, state: VehicleState | None, status: Status) -> None:
        {
            Phase.CONNECT: self._connect,
            Phase.PREFLIGHT: self._preflight,
            Phase.STREAM: self._idle,
            Phase.OFFBOARD: self._offboard,
            Phase.ARM: self._arm,
            Phase.TAKEOFF: self._takeoff,
            Phase.HOLD: self._hold,
            Phase.TRACK: self._track,
            Phase.RETURN: self._return,
            Phase.SAFE_HOLD: self._safe_hold,
            Phase.BLIND: self._blind,
            Phase.LAND: self._land,
            Phase.DISARM: self._disarm,
            Phase.WATCH: self._watching,
            Phase.DONE: lambda state, status: None,
        }[self.phase](state, status)

    def _connect(self, state: VehicleState | None, status: Status) -> None:
        if state is not None and status.heartbeat > -inf:
            self._go(Phase.PREFLIGHT)
        elif self._elapsed > self.options.connect:
            self._refuse(why_no_state(self.endpoint, self.options.connect))

    def _preflight(self, state: VehicleState | None, status: Status) -> None:
        if self._every(0.3):
            for name in (*preflight.PARAMETERS, *failsafe.OPTIONAL):
                if name not in status.parameters:
                    self.endpoint.ask_parameter(name)
            if self.options.takeover:
                self.endpoint.ask_home()
        found = preflight.faults(
            self.endpoint,
            status,
            state,
            self.path,
            self.limits,
            options=self.options,
            now=self._now,
        )
        if found:
            self._good_since = None
            if self._bad_since is None:
                self._bad_since = self._now
            if self._now - self._bad_since > self.options.checks:
                self._list(found, status)
                self._refuse("not fit to fly: " + "; ".join(found))
            return
        self._bad_since = None
        if self._good_since is None:
            self._good_since = self._now
        known = all(name in status.parameters for name in preflight.PARAMETERS)
        if (
            self._now - self._good_since < 1.0
            or not (known or self._elapsed > 3.0)
            or not self._controller_ready()
        ):
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
            self._say(f"           refused: {line}")
        for line in preflight.warnings(self.endpoint, status, self.path, self.limits):
            self._say(f"           note: {line}")

    def _controller_ready(self) -> bool:
        self.runner.collect()
        if self.runner.fault is not None:
            self._refuse(f"the controller failed: {self.runner.fault}")
        return self.runner.ready and self.runner.fault is None

    def _idle(self, state: VehicleState | None, status: Status) -> None:
        self.streaming = True
        self._send_first(state)
        if self._elapsed > self.options.idle:
            self._go(Phase.OFFBOARD)

    def _send_first(self, state: VehicleState | None) -> None:
        """What PX4 follows when it enters OFFBOARD: nothing on the ground, in the air to stay where it is."""
        if not self._lifted or state is None:
            self._send_idle(0.0)
            return
        self._cascade.reset()
        self._hold_at(Point(state.p, yaw=yaw_of(state.q)), state)

    def _offboard(self, state: VehicleState | None, status: Status) -> None:
        self._send_first(state)
        if status.mode == d.OFFBOARD:
            self._go(Phase.HOLD if self._lifted else Phase.ARM)
        elif self._lifted and status.mode != d.HOLD:
            self._refuse(f"the operator chose {status.mode}")
        elif self._elapsed > self.options.confirm:
            self._refuse(f"OFFBOARD was refused, the mode is {status.mode}: {self._texts(status)}")
        elif self._every(1.0):
            self.endpoint.ask_mode(d.OFFBOARD)

    def _arm(self, state: VehicleState | None, status: Status) -> None:
        self._send_idle(0.0)
        if status.armed:
            self._cascade.reset()
            self._go(Phase.TAKEOFF)
        elif self._elapsed > self.options.confirm:
            self._refuse(f"arming was refused: {self._texts(status)}")
        elif self._every(1.0):
            self.endpoint.command(d.ARM, 1.0)

    @property
    def _top(self) -> float:
        """Height of take-off: past that at which PX4 resets its heading, where the fence has room for it [m]."""
        highest = self.limits.fence[2][1] - preflight.climb_room(self.options)
        return max(self.options.height, min(self.options.climb_past, highest))

    def _takeoff(self, state: VehicleState | None, status: Status) -> None:
        if state is None or self.home is None:
            return
        rise = self._elapsed - self.options.spool
        if rise < 0:
            self._send_idle(0.4 * self.hover.value * self._elapsed / self.options.spool)
            return
        top = self._ground + self._top
        z = min(self._ground + self.options.climb * rise, top)
        if not self._lifted:
            # the wanted height does not run away from a vehicle that still stands
            z = min(z, self._ground + 0.4)
            if state.p[2] > self._ground + 0.1:
                self._lifted = True
                self._since = (
                    self._now - self.options.spool - (state.p[2] - self._ground) / self.options.climb
                )
            elif rise > self.options.lift:
                self._disarm_or_land(Trouble("lift", "it does not lift off", Action.LAND), status)
                return
        speed = self.options.climb if z < top else 0.0
        self._hold_at(Point((self.home[0], self.home[1], z), (0.0, 0.0, speed), yaw=self._yaw), state)
        if self._lifted and abs(state.p[2] - top) < 0.15 and length(state.v) < 0.4 and z >= top:
            self._go(Phase.HOLD)

    def _hold(self, state: VehicleState | None, status: Status) -> None:
        """Hover, go to the start of the reference, and wait until the controller plans."""
        if state is None or self.home is None:
            return
        start = self.path.at(0.0)
        goal = self._moved(start.p)
        if self._elapsed < self.options.hold:
            at, yaw = self._where.p, self._where.yaw
        else:
            at = self._towards(self._where.p, goal, self.options.approach)
            yaw = self._turn_towards(self._where.yaw, start.yaw)
        self._hold_at(Point(at, yaw=yaw), state)
        if (
            distance(state.p, goal) < 0.5
        ):  # integrals and the like of the controller should not grow on the way
            self.runner.offer(self._own(state), state.time, 0.0, tuple(self._left))
        self.runner.collect()
        ready = self.runner.plan is not None and self._now - self.runner.plan.time < self.limits.solver
        there = distance(state.p, goal) < 0.25 and length(state.v) < 0.3 and at == goal and yaw == start.yaw
        if self._elapsed > self.options.hold + 1.0 and there and ready:
            self.started = self._now
            self._go(Phase.TRACK, self.path.name)
        elif self._elapsed > self.options.hold + 60.0:
            why = (
                "the start of the reference is not reached"
                if ready
                else "the controller does not plan in time"
            )
            self._act(Trouble("solver" if not ready else "start", why, Action.HOLD), state, status)

    def _track(self, state: VehicleState | None, status: Status) -> None:
        if state is None or self.started is None:
            return
        t = self._now - self.started
        self.runner.offer(self._own(state), state.time, state.time - self.started, tuple(self._left))
        self.runner.collect()
        plan = self.runner.plan
        assert plan is not None  # the reference begins with one
        trouble = self._tracking_trouble(plan, state, state.time - self.started)
        if trouble is not None:
            self._act(trouble, state, status)
        elif t > self.path.duration + 0.5:
            self.outcome.tracked = True
            self._where = self._stop_point(state)
            self._go(Phase.RETURN)
        elif self._late(plan):
            self._follow_without_plans(state, state.time - self.started)
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
            self._say(
                f"           note: plans are late at {t:.1f} s; the built-in cascade flies the reference"
            )
        self.outcome.without_plans += max(self._now - self._last, 0.0)
        to = self.path.led(t, LEAD)
        self._hold_at(replace(to, p=self._moved(to.p)), state)

    def _tracking_trouble(self, plan: DemandPlan, state: VehicleState, t: float) -> Trouble | None:
        """Why the controller may not fly on, with the state of a time in the reference [s]."""
        assert self._watch is not None
        if self.runner.fault is not None:
            return Trouble("solver", f"the controller failed: {self.runner.fault}", Action.HOLD)
        if self._late(plan) and self.outcome.without_plans > self.limits.without_plans:
            text = f"plans were older than {self.limits.solver:g} s for {self.outcome.without_plans:.1f} s in all"
            return Trouble("solver", text, Action.HOLD)
        if "failed" in plan.status:
            return Trouble("solver", f"the controller says: {plan.status}", Action.HOLD)
        off = distance(state.p, self._moved(self.path.at(t).p))
        return self._watch.track(off, plan, self._now)

    def _return(self, state: VehicleState | None, status: Status) -> None:
        """Come to rest, and where that is asked for fly back: the next flight then has the same place and fence."""
        if state is None or self.home is None or self._watch is None:
            return
        at = goal = self._where.p
        if self.options.come_back:
            goal = self._watch.inside((self.home[0], self.home[1], self._ground + self.options.height))
        if self._elapsed > REST:
            at = self._towards(at, goal, self.options.approach)
        if at != goal or self._elapsed <= REST:
            self._arrived = self._now
        self._hold_at(Point(at, yaw=self._where.yaw), state)
        if self._now > self._arrived and (length(state.v) < 0.4 or self._now - self._arrived > SETTLE):
            self._go(Phase.LAND)

    def _safe_hold(self, state: VehicleState | None, status: Status) -> None:
        if state is None:
            return
        self._hold_at(self._where, state)
        if self._elapsed > self.options.safe_hold:
            self._go(Phase.LAND)

    def _blind(self, state: VehicleState | None, status: Status) -> None:
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

    def _land(self, state: VehicleState | None, status: Status) -> None:
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

    def _disarm(self, state: VehicleState | None, status: Status) -> None:
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

    def _watching(self, state: VehicleState | None, status: Status) -> None:
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
