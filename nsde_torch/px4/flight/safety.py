"""What can go wrong in flight, how it is seen, and what is done about it.

| trouble | seen by | action |
|---|---|---|
| estimate too old or lost | age of the newest state | level, PX4's own LAND at once; silence if that is not confirmed |
| link silent | no message at all | silence: PX4 fails over by itself, and we never stream again |
| plans late | age of the newest | the built-in cascade flies the reference for 3 s in all; then hold, then LAND |
| solver failed, dead | its words, its process | hold by the built-in cascade, then LAND |
| outside the fence, too fast, too steep | the state | hold (inside the fence), then LAND |
| reference not followed | the distance from it, while it is flown | hold, then LAND |
| plans that tip, again and again | words of the plans | hold, then LAND |
| estimate of position or velocity jumped | the state against its prediction | hold, then LAND |
| estimate that its own sensors contradict | innovation ratios, accuracy (ESTIMATOR_STATUS) | LAND at once |
| estimate of the heading jumped | the same | noted; a heading that is held moves with it |
| battery low | SYS_STATUS | LAND at once |
| setpoints of another client | ATTITUDE_TARGET, POSITION_TARGET_LOCAL_NED | LAND at once: that mode obeys no client |
| another mode | HEARTBEAT | silence and stay out: the operator, or PX4's failsafe, has the vehicle |
| disarmed | HEARTBEAT | silence |
| Ctrl-C | signal | hold, then LAND; twice: LAND at once |
| this process stood still longer than PX4 waits | time between ticks | silence: setpoints would undo PX4's failsafe |
| link dead | nothing heard for 10 s | no longer waited on; not seen to land |
| crash of a part | exception | hold if the loop lives, else LAND is asked for and the stream ends |
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from math import inf, isfinite, radians
from typing import final

from nsde_torch.px4.flight.controller import TIPPED, DemandPlan
from nsde_torch.px4.link.telemetry import EstimateQuality, Followed, Status, VehicleState
from nsde_torch.px4.link.vectors import (
    Vec,
    conjugate,
    distance,
    length,
    multiply,
    plus,
    rotation_vector,
    scaled,
    tilt_of,
    turned_by_rates,
)
from nsde_torch.px4.options import Limits

# Steps of the autopilot's estimate: a state against what the one before it predicts.
#
#     position |p' - p - v dt|,    velocity |v' - v| - a dt,    heading z of log(q' (q exp(w dt))^-1),    a = 30 m/s2
#
# Estimators reset themselves. A step of the heading alone is harmless, PX4 makes one in every flight; one of
# position or velocity is a fall or a leap to whoever flies by it.

HARDEST = 30.0  # acceleration that thrust and gravity may make [m/s2]: a small multirotor at full throttle
UNANNOUNCED = radians(3.0)
"""Step of the heading that is a reset though nothing announced it: ATTITUDE_QUATERNION has no counter [rad]."""
LONGEST = 0.5  # longest time between two states that are compared [s]


@dataclass(frozen=True)
class EstimateStep:
    """What a reset changed."""

    position: float  # [m]
    velocity: float  # beyond what thrust explains [m/s]
    heading: float  # counter-clockwise from above [rad]
    announced: bool  # whether the autopilot said so


def step_between(last: VehicleState, state: VehicleState) -> EstimateStep | None:
    """The step from one state to a later one; None where they are the same, or too far apart to compare."""
    dt = state.stamp - last.stamp
    if not 0.0 < dt < LONGEST:
        return None
    before = turned_by_rates(last.q, scaled(plus(last.w, state.w), 0.5), dt)
    turn = multiply(state.q, conjugate(before))
    return EstimateStep(
        distance(state.p, plus(last.p, last.v, dt)),
        max(distance(state.v, last.v) - HARDEST * dt, 0.0),
        rotation_vector(turn)[2],
        state.resets != last.resets,
    )


MARGIN = 0.3
"""Distance from the fence's edge that is kept where the place can be chosen: to hold, and below its top [m]."""
TIPPED_WINDOW = 5.0  # time within which plans that tip are counted [s]
FOREIGN, FOREIGN_WINDOW = 3, 1.0
"""Setpoints of another client that end a flight, and the time within which they are counted [s].

A mode that has just ended leaves one or two.
"""
QUALITY_AGE = 2.0
"""Age from which on what an estimator said of itself is no longer judged [s]; it says so five times a second."""
SAME_RATE = 1e-3
"""Difference up to which rates are the ones that were sent: they come back as floats of four bytes [rad/s]."""


class Action(Enum):
    """What is done about a trouble, the strongest last."""

    HOLD = 1
    LAND = 2
    BLIND = 3
    SILENCE = 4


@dataclass(frozen=True)
class Trouble:
    """Something went wrong: what it is called, in words, and what to do."""

    kind: str
    text: str
    action: Action


def contradicted(quality: EstimateQuality | None, limits: Limits, now: float, *, part: float = 1.0) -> str:
    """What an estimator says against its own estimate, in words; empty: nothing.

    The heading is not in it: PX4's is wrong by design until it is reset in the climb. An error that the estimator does
    not know of, as of a satellite receiver that is wrong by a metre, shows in none of these. `part` is the share of the
    largest innovation ratio that is allowed.
    """
    if quality is None or now - quality.time > QUALITY_AGE:
        return ""
    q, most = quality, part * limits.innovation
    ratios = ((q.velocity_ratio, "velocity"), (q.position_ratio, "position"), (q.height_ratio, "height"))
    ratio, worst = max((one for one in ratios if isfinite(one[0])), default=(0.0, ""))
    if ratio > most:
        return f"the estimator's {worst} innovation ratio is {ratio:.2f}, more than {most:g}"
    deviation = max((s for s in (q.horizontal_m, q.vertical_m) if isfinite(s)), default=0.0)
    if deviation > (most := limits.accuracy):
        return f"the estimator gives its position an error of {deviation:.1f} m, more than {most:g}"
    return ""


_UNSUITED = "the controller or its model does not suit the machine, or its plans come too late"


@final
@dataclass(eq=False)
class Watch:
    """Looks at state and status of a flight, and says what is wrong."""

    limits: Limits
    home: Vec  # place of take-off [m]

    def __post_init__(self) -> None:
        self._since: dict[str, float] = {}
        self._last: VehicleState | None = None
        self._jumped: str | None = None
        self._against = ""
        self._plan: DemandPlan | None = None
        self._tipped: deque[float] = deque()
        self._foreign: deque[Followed] = deque()
        self.steps: list[EstimateStep] = []  # resets that were announced or seen, since somebody took them

    def look(self, state: VehicleState | None, status: Status, now: float) -> Trouble | None:
        """The strongest trouble at a time [s]; None: all is well."""
        m = self.limits
        if now - status.heard > m.silence:
            return Trouble("link", f"nothing heard for {now - status.heard:.2f} s", Action.SILENCE)
        age = inf if state is None else now - state.time
        if state is None or age > m.estimate:
            return Trouble("estimate", f"the newest state is {age:.2f} s old", Action.BLIND)
        if now - status.heartbeat > m.heartbeat:
            return Trouble("heartbeat", f"no heartbeat for {now - status.heartbeat:.1f} s", Action.LAND)
        low = isfinite(status.remaining) and status.remaining < m.battery
        weak = isfinite(status.voltage) and status.voltage < m.voltage
        if self._lasting("battery", low or weak, now, 0.5):
            text = f"battery at {100 * status.remaining:.0f} % and {status.voltage:.1f} V"
            return Trouble("battery", text, Action.LAND)
        self._against = contradicted(status.quality, m, now)
        if self._lasting("quality", bool(self._against), now, m.innovation_time):
            return Trouble("quality", f"{self._against}: it may not be where it says", Action.LAND)
        return self._motion(state, now)

    def track(self, off: float, plan: DemandPlan, now: float) -> Trouble | None:
        """What is wrong with how the reference is followed, `off` [m] from it by the newest plan; None: nothing."""
        m = self.limits
        if plan is not self._plan and TIPPED in plan.status:
            self._tipped.append(now)
        self._plan = plan
        while self._tipped and self._tipped[0] < now - TIPPED_WINDOW:
            self._tipped.popleft()
        if len(self._tipped) > m.tipped_plans:
            text = f"{len(self._tipped)} plans within {TIPPED_WINDOW:g} s tilted beyond {m.tilt:g} deg"
            return Trouble("tipped", f"{text}: {_UNSUITED}", Action.HOLD)
        if self._lasting("tracking", off > m.tracking_error, now, m.tracking_time):
            text = f"more than {m.tracking_error:g} m from the reference for {m.tracking_time:g} s, now {off:.2f} m"
            return Trouble("tracking", f"{text}: {self._against or _UNSUITED}", Action.HOLD)
        return None

    def check_setpoints(
        self, followed: deque[Followed], sent: Sequence[Vec], offboard: float
    ) -> Trouble | None:
        """Whether the autopilot follows setpoints that are not ours; None: it does not.

        What it says that it follows is taken away as far as it is judged; `sent` are rates [rad/s], for as long as PX4
        may hold them. `offboard` is when it last said that it is in OFFBOARD [s]: in other modes it follows its own.
        """
        while followed and followed[0][0] <= offboard:
            time, w = followed.popleft()
            if w is None or not any(distance(w, own) < SAME_RATE for own in reversed(sent)):
                self._foreign.append((time, w))
        while self._foreign and self._foreign[0][0] < offboard - FOREIGN_WINDOW:
            self._foreign.popleft()
        if len(self._foreign) < FOREIGN:
            return None
        _, w = self._foreign[-1]
        if w is None or any(rates is None for _, rates in self._foreign):
            what = "a position"  # and the rates that its loops make of it
        else:
            what = f"rates of ({w[0]:.2f}, {w[1]:.2f}, {w[2]:.2f}) rad/s"
        text = f"PX4 follows {what}, which was not sent from here: stop the other client that sends setpoints"
        return Trouble("setpoints", text, Action.LAND)

    def _motion(self, state: VehicleState, now: float) -> Trouble | None:
        m = self.limits
        at, speed, tilt = plus(state.p, self.home, -1.0), length(state.v), tilt_of(state.q)
        self._look_for_steps(state)
        where = f"outside the fence at ({at[0]:.1f}, {at[1]:.1f}, {at[2]:.1f}) m"
        checks = (
            ("fence", m.outside(state.p, self.home), where),
            ("speed", speed > m.speed, f"{speed:.1f} m/s is more than {m.speed:g}"),
            ("tilt", tilt > m.tilt, f"tilt of {tilt:.0f} deg is more than {m.tilt:g}"),
        )
        for kind, wrong, text in checks:
            if self._lasting(kind, wrong, now, m.patience):
                return Trouble(kind, text, Action.HOLD)
        if self._jumped is not None:
            text, self._jumped = self._jumped, None
            return Trouble("jump", text, Action.HOLD)
        return None

    def _look_for_steps(self, state: VehicleState) -> None:
        last, self._last = self._last, state
        step = None if last is None else step_between(last, state)
        if step is None:
            return
        if step.position > self.limits.jump:
            self._jumped = f"the position jumped by {step.position:.2f} m"
        elif step.velocity > self.limits.velocity_jump:
            self._jumped = f"the velocity jumped by {step.velocity:.2f} m/s"
        if step.announced or abs(step.heading) > UNANNOUNCED or self._jumped is not None:
            self.steps.append(step)

    def _lasting(self, kind: str, wrong: bool, now: float, patience: float) -> bool:
        if not wrong:
            self._since.pop(kind, None)
            return False
        return now - self._since.setdefault(kind, now) >= patience

    def inside(self, p: Vec) -> Vec:
        """The nearest point well inside the fence."""
        walls = zip(p, self.home, self.limits.fence, strict=True)
        x, y, z = (min(max(c, h + min(low + MARGIN, 0)), h + high - MARGIN) for c, h, (low, high) in walls)
        return (x, y, z)


class Phase(Enum):
    """Where in the flight we are."""

    CONNECT = "connect"
    PREFLIGHT = "preflight"
    STREAM = "stream"
    OFFBOARD = "offboard"
    ARM = "arm"
    TAKEOFF = "take off"
    HOLD = "hold"
    TRACK = "track"
    RETURN = "return"
    SAFE_HOLD = "safe hold"
    BLIND = "blind"
    LAND = "land"
    DISARM = "disarm"
    WATCH = "watch"
    DONE = "done"


FLYING = (Phase.TAKEOFF, Phase.HOLD, Phase.TRACK, Phase.RETURN, Phase.SAFE_HOLD)
"""Phases in which we fly the vehicle and it must be in OFFBOARD."""


REFUSED = "refused"  # kind of the trouble of a flight that was not begun


@dataclass
class FlightOutcome:
    """How a flight ended."""

    tracked: bool = False  # the reference was flown to its end
    landed: bool = False  # on the ground and disarmed, as telemetry says
    trouble: Trouble | None = None  # the first thing that went wrong
    actions: list[tuple[float, str, str]] = field(default_factory=list)
    """The phases of the flight, with their times from the start [s] and the reason."""
    without_plans: float = 0.0
    """Time for which the built-in cascade flew the reference, because plans were late [s]."""
    steps: list[tuple[float, EstimateStep]] = field(default_factory=list)
    """Resets of the estimate in flight, with their times from the start [s]."""

    @property
    def begun(self) -> bool:
        """Whether it came to arming or was taken over; before that, and where it was refused, nothing was moved."""
        refused = self.trouble is not None and self.trouble.kind == REFUSED
        return not refused and any(
            phase in (Phase.ARM.value, Phase.HOLD.value) for _, phase, _ in self.actions
        )
