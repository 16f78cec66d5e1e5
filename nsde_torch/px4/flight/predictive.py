"""The predictive controller for PX4: body rates and thrust out of its plan.

What is sent at t acts at t + delay: the line, the rate loop and the motors follow late. So the state is carried forward
over the delay by what was asked for meanwhile, and the plan starts there:

    rates(t) = omega(plan, t + delay + lead),      thrust(t) = thrust(plan, t + delay) / mass

`lead` is the time in which a rate that is asked for is reached. What pushes the vehicle that the model does not know
is learned from its velocities (`carried`), apart from it how it brakes, and planned with; what is off all the same
moves the reference slowly, p_ref + trim with trim' = (p_ref - p) / T.

A solver that starts from a plan that came late may end in another valley of its cost, which leads over the top: a plan
that tilts beyond what ends a flight is not flown. Another is made from hovering, or the one before goes on.
"""

import copy
import time as clock
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from math import cos, radians
from pathlib import Path
from typing import Any, final

import torch
from torch import Tensor

from nsde_torch.control.controller import HOVER, KEPT, Controller, Planner, SafetyOptions, setpoints
from nsde_torch.control.controller import Plan as MotorPlan
from nsde_torch.control.loop import knowledge
from nsde_torch.control.problem import ProblemOptions
from nsde_torch.control.reference import FlightPath, Reference
from nsde_torch.control.solve import SolverOptions
from nsde_torch.effects import Port
from nsde_torch.errors import ConfigError
from nsde_torch.export.exported import ExportedController
from nsde_torch.models import Model
from nsde_torch.px4.flight.cascade import GRAVITY, PAUSE
from nsde_torch.px4.flight.controller import TIPPED, Asked, Demand, DemandPlan
from nsde_torch.px4.link.connection import PLANS, urgent
from nsde_torch.px4.link.vectors import Vec, bounded, parts, plus, rotate, rotate_back, turned_by_rates
from nsde_torch.systems import Multirotor, System
from nsde_torch.systems.machines import Effects, named_effects

# The state that a vehicle will be in, by what was asked for, and what pushes it that the model does not know.
#
#     q' = q * w / 2,   v' = R ((0, 0, f) - D R'v + d) - g,   p' = v      with (w, f) asked for a delay before
#
# `D` is what the model says of braking by speed: a drag of 1 1/s is 0.2 m/s over a delay at 3 m/s. `d`
# follows from how wrong the velocity was that had been predicted, as in `nsde_torch.control.autopilots`,
#
#     d' = d + R'(v - v_predicted) / T
#
# A push that goes with the speed comes a quarter of a period of the path too late that way, so that it is
# learned as braking, D_i' = D_i - dt / 2 s d_i u_i / (u_i^2 + (1 m/s)^2) with u = R'v, and `d` keeps the
# rest. On a hexacopter with a drag of 0.7, 0.5, 0.3 1/s that its model does not know: 4.2 cm off a lemniscate
# at 3.4 m/s, and 9.4 cm by `d` alone.

SLOPE_TIME, LEARNT_FROM, STEEPEST = 2.0, 1.0, 1.0
"""Time constant of learning how it brakes [s], speed below which little is learned [m/s], largest slope [1/s]."""
LONGEST = 0.2  # time between two states beyond which nothing is learned from them [s]
PUSH_TIME, PUSH_LIMIT = 0.2, 4.0
"""Time constant [s] and largest size along each axis [m/s2] of the push that is learned."""
STEP = 0.01  # longest step of the integration, about [s]
Drag = tuple[Vec, Vec, Vec]
NO_DRAG: Drag = ((0.0, 0.0, 0.0),) * 3
NO_PUSH: Vec = (0.0, 0.0, 0.0)


def carried(
    row: tuple[float, ...],
    time: float,
    span: float,
    asked: Asked,
    *,
    delay: float,
    drag: Drag = NO_DRAG,
    push: Vec = NO_PUSH,
) -> tuple[float, ...]:
    """The state a `span` [s] later, by what was asked for, of a row (13,), ENU and FLU, that was valid at `time`.

    Args:
        delay: From a setpoint to its effect [s].
        drag: How the machine brakes by its speed along the body, D of a = -D v [1/s].
        push: Acceleration along the body's axes that the model does not know [m/s2].
    """
    p, v, q, w = parts(row)
    steps = max(round(span / STEP), 1)
    dt = span / steps
    times = [left for left, _ in asked]
    for k in range(steps):
        newest = bisect_right(times, time - delay + (k + 0.5) * dt) - 1
        thrust = GRAVITY  # where nothing is known it hovers
        if newest >= 0:
            w, thrust = asked[newest][1].w, asked[newest][1].thrust
        u = rotate_back(q, v)
        x, y, z = (d[0] * u[0] + d[1] * u[1] + d[2] * u[2] for d in drag)
        force = rotate(q, (push[0] - x, push[1] - y, push[2] + thrust - z))
        a = (force[0], force[1], force[2] - GRAVITY)
        p, v = plus(plus(p, v, dt), a, 0.5 * dt * dt), plus(v, a, dt)
        q = turned_by_rates(q, w, dt)
    return (*p, *v, *q, *w)


@final
@dataclass(eq=False)
class PushEstimate:
    """What pushes the vehicle, learned from velocities while it flies."""

    delay: float  # see `carried`
    known: Drag  # how the machine brakes, as the model says [1/s]

    def __post_init__(self) -> None:
        self.rest = self.slopes = NO_PUSH
        self._last: tuple[float, tuple[float, ...]] | None = None

    @property
    def drag(self) -> Drag:
        """How the machine brakes, as the model says and as was learned [1/s]."""
        (a, b, c), (k, m, n) = self.known, self.slopes
        return ((a[0] + k, a[1], a[2]), (b[0], b[1] + m, b[2]), (c[0], c[1], c[2] + n))

    def at(self, row: tuple[float, ...]) -> Vec:
        """The push that the model does not know, at a state of 13 numbers [m/s2]."""
        _, v, q, _ = parts(row)
        (d, e, f), (k, m, n), (x, y, z) = self.rest, self.slopes, rotate_back(q, v)
        return bounded((d - k * x, e - m * y, f - n * z), PUSH_LIMIT)

    def take(self, row: tuple[float, ...], time: float, asked: Asked) -> None:
        """Learn from a state of 13 numbers, when it was valid [s], and what was sent lately."""
        last, self._last = self._last, (time, row)
        if last is None or not 0.0 < time - last[0] <= LONGEST:
            return
        dt = time - last[0]
        told = carried(last[1], last[0], dt, asked, delay=self.delay, drag=self.drag, push=self.rest)
        _, v, q, _ = parts(row)
        error = rotate_back(q, plus(v, parts(told)[1], -1.0))
        self.rest = bounded(plus(self.rest, error, 1.0 / max(PUSH_TIME, dt)), PUSH_LIMIT)
        u = rotate_back(q, v)
        k, m, n = (
            min(max(s - dt / SLOPE_TIME * d * v / (v * v + LEARNT_FROM * SLOW), -STEEPEST), STEEPEST)
            for s, d, v in zip(self.slopes, self.rest, u, strict=True)
        )
        # the push at this state stays what it is, whatever it is put down to
        x, y, z = plus((k, m, n), self.slopes, -1.0)
        self.rest = bounded(plus(self.rest, (x * u[0], y * u[1], z * u[2])), PUSH_LIMIT)
        self.slopes = (k, m, n)


DELAY, LEAD = 0.08, 0.01
"""Measured best on a real PX4 in simulation [s]: rates that are asked for are there 88 ms later."""
TRIM_TIME, TRIM_LIMIT = 10.0, 0.3  # time constant [s] and largest size [m] of the trim
TILT = radians(65.0)  # tilt of a plan that is not flown [rad]; that at which a flight ends
KEEP = 0.25  # longest time for which the plan before goes on where new ones tilt too far [s]
COLD, WARM_UP = 10, 60
"""Plans that are made before a flight and not looked at, and those that are, along the reference."""
SLOWEST, TAIL = 0.1, 0.05
"""Longest time of a plan [s] that no more than this share of the warm-up's may exceed: late plans end flights."""


COVERED = ("input_delay", "motor_lag", "actuator_lag", "asymmetric_lag")
"""Effects that `delay` makes up for: a controller that knows them too would make up for them twice."""


def told(effects: Effects) -> list[dict[str, Any]]:
    """Effects, as a diagnosis found them, that a controller of rates and thrust needs to know: not only lateness."""
    return [{name: values} for name, values in named_effects(effects).items() if name not in COVERED]


def without_covered(known: Model | System) -> Model | System:
    """What is known of a machine, without what `delay` makes up for.

    A trained model has learned the motors' lag. Beside `delay`, and with motors that stand at the plan's first command,
    a quadrotor flew 54 cm beside its path (rms) on its own machine, with 103 plans that tipped; without, 2.7 cm.
    """
    if isinstance(known, System):
        return known.without_effects(*COVERED)
    out = copy.deepcopy(known)
    out.system = known.system.without_effects(*COVERED)
    return out


def check_uncovered(system: System) -> None:
    """ConfigError for a model that knows what `delay` makes up for: a file of `nsde export` cannot be changed."""
    known = [name for name in system.effect_names if name in COVERED]
    if known:
        raise ConfigError(
            f"the controller plans with {', '.join(known)}, which `delay` makes up for: both together tip the vehicle. "
            "Fly the run directory that the file was made of (run=DIR), or export a model that was trained with "
            "model.learn_lag=false."
        )


SLOW = 2.0  # speed at which a model is asked how it brakes [m/s]


def braking(controller: Controller) -> Drag:
    """How a controller's model brakes by its speed along the body, D of a = -D v: slopes at hovering, level [1/s]."""
    known = controller.predictor
    x = torch.zeros(6, known.nx, dtype=known.dtype)
    x[:, 6] = 1.0
    x[:3, 3:6], x[3:, 3:6] = SLOW * torch.eye(3), -SLOW * torch.eye(3)
    u = controller.hover.to(known.dtype).expand(6, -1)
    a = known.drift(known.augment(x, u), u, x.new_zeros(6, known.nd))[:, 3:6]
    rows = ((a[3:] - a[:3]) / (2.0 * SLOW)).T.tolist()
    return tuple((row[0], row[1], row[2]) for row in rows)  # type: ignore[return-value]


@final
@dataclass(eq=False)
class PredictiveController:
    """Plans with a model; a `FlightController`.

    ConfigError: the model is of no multirotor, or knows an effect that `delay` makes up for.
    """

    controller: Planner  # the solver and what it pays for; batch of one
    reference: Reference  # where to fly
    _: KW_ONLY
    delay: float = DELAY  # from a setpoint to its effect [s]
    lead: float = LEAD  # how much earlier than the plan says rates are asked for [s]
    tilt: float = TILT  # beyond which a plan is not flown [rad]

    def __post_init__(self) -> None:
        predictor = self.controller.predictor
        if not isinstance(predictor.system, Multirotor):
            raise ConfigError(f"PX4 flies multirotors; the model is of a {predictor.system.name!r}.")
        check_uncovered(predictor.system)
        self._upright = cos(self.tilt)
        self._system, self._ports = predictor.system, predictor.ports
        self._drag = braking(self.controller) if isinstance(self.controller, Controller) else NO_DRAG
        self.reset()

    def reset(self) -> None:
        """Forget the last flight."""
        self._last: tuple[float, MotorPlan] | None = None
        self._push = PushEstimate(self.delay, self._drag)
        self._trim = torch.zeros(3, dtype=torch.float64)

    @torch.no_grad()
    def __call__(self, row: tuple[float, ...], time: float, t: float, asked: Asked = ()) -> DemandPlan:
        """See `FlightController`."""
        started = clock.perf_counter()
        c, o = self.controller, self.controller.options
        window = self.reference.window(t + self.delay, dt=o.dt, steps=o.steps)
        elapsed = 0.0 if self._last is None else time - self._last[0]
        if abs(elapsed) > PAUSE:
            self.reset()
        elapsed = max(elapsed, 0.0)  # clocks are compared anew now and then, and a state may seem the older
        if t > 0.0:
            wanted = self.reference.at(torch.tensor(t))[:3]
            off = wanted - torch.tensor(row[:3], dtype=torch.float64)
            self._trim = self._trim + off * (min(elapsed, 0.1) / TRIM_TIME)
            self._trim = self._trim.clamp(-TRIM_LIMIT, TRIM_LIMIT)
        window[:, :3] += self._trim
        before, known = None if self._last is None else self._last[1], self._push
        known.take(row, time, asked)
        ahead = carried(row, time, self.delay, asked, delay=self.delay, drag=known.drag, push=known.rest)
        x = torch.tensor([ahead], dtype=torch.float64)
        forces = self._forces(known.at(ahead))
        plan = c.plan(x, window[None], before, elapsed=elapsed, push=forces)
        status = f"{plan.status[0]}: failed" if plan.status[0].endswith(HOVER) else plan.status[0]
        if self._tips(plan):
            plan, status = self._upright_plan(x, window, before, elapsed, forces)
        self._last = (time, plan)
        rates, thrust = (one[0].tolist() for one in setpoints(plan, self._system, ahead=self.lead))
        demands = tuple(Demand((w[0], w[1], w[2]), a) for w, a in zip(rates, thrust, strict=True))
        took = 1e3 * (clock.perf_counter() - started)
        return DemandPlan(time, plan.dt, demands, status, took)

    def _forces(self, push: Vec) -> Tensor | None:
        """The push on the ports of the model (1, nd); None where it has none."""
        own = ((push if port is Port.BODY_FORCE else (0.0,) * n) for port, n in self._ports.items())
        forces = [x for part in own for x in part]
        return torch.tensor([forces], dtype=torch.float64) if forces else None

    def _tips(self, plan: MotorPlan) -> bool:
        """Whether a plan tilts too far; one that begins beyond the limit may come back from it."""
        up = 1.0 - 2.0 * (plan.x[0, :, 7] ** 2 + plan.x[0, :, 8] ** 2)
        return float(up.min()) < min(self._upright, float(up[0]) - 1e-3)

    def _upright_plan(
        self, x: Tensor, window: Tensor, before: MotorPlan | None, elapsed: float, push: Tensor | None
    ) -> tuple[MotorPlan, str]:
        """A plan from hovering instead of one that tips, else the one before, and its status."""
        plan = self.controller.plan(x, window[None], push=push)
        if not self._tips(plan):
            return plan, f"{plan.status[0]}:{TIPPED}"
        if before is None:
            return plan, f"{TIPPED}: failed"
        kept = before.shifted(elapsed)
        return kept, f"{TIPPED}:{KEPT}" if float(kept.age[0]) <= KEEP else f"{TIPPED}: failed"


@dataclass(frozen=True)
class PredictiveMaker:
    """Makes the controller in the process that it runs in; everything in it can be sent there."""

    run: str  # run directory of a model, a file of `nsde export`, or `declared`: physics with the plant's values
    system: str  # name of the machine
    path: FlightPath  # where to fly
    problem: ProblemOptions  # what a plan pays for
    solver: SolverOptions  # how it is found
    safety: SafetyOptions  # when to reject a state or a plan
    delay: float = DELAY  # see `PredictiveController`
    lead: float = LEAD  # likewise
    tilt: float = TILT  # likewise
    effects: Effects = ()  # effects beside the declared ones, for `declared`
    threads: int = 1  # threads of torch

    def __call__(self, say: Callable[[str], None]) -> PredictiveController:
        """Load, compile, and solve some times, so that the first plan in flight is none of a cold start.

        ConfigError where plans take too long to fly on.
        """
        torch.set_num_threads(self.threads)
        controller: Planner
        if Path(self.run).is_file():
            controller = file = ExportedController(self.run)
            how = f"a file, {file.record['kind']}"
        else:
            known = without_covered(knowledge(self.run, self.system, effects=self.effects))
            controller = Controller(
                known, problem=self.problem, solver=self.solver, safety=self.safety, say=say
            )
            how = "compiled" if controller.solver.compiled else "not compiled"
        reference = Reference(self.path)
        made = PredictiveController(controller, reference, delay=self.delay, lead=self.lead, tilt=self.tilt)
        times = [self.path.duration * k / (COLD + WARM_UP) for k in range(COLD + WARM_UP)]
        with urgent(PLANS):  # as they are in flight
            plans = [made(tuple(reference.at(torch.tensor(t)).tolist()), t, t) for t in times]
        solves = sorted(plan.solve_ms for plan in plans[COLD:])
        median, took = (solves[int(share * WARM_UP)] for share in (0.5, 1.0 - TAIL))
        if took > 1e3 * SLOWEST:
            raise ConfigError(
                f"one plan in {1.0 / TAIL:.0f} takes {took:.0f} ms or longer, half of them {median:.0f} ms (solver "
                f"{how}); at most {1e3 * SLOWEST:.0f} ms can be flown on. Stop what else runs here, install a "
                "C compiler (gcc), or make plans shorter: mpc.steps, mpc.iterations."
            )
        say(
            f"the controller plans in {median:.1f} ms, one time in {1.0 / TAIL:.0f} in {took:.1f} ms or longer ({how})"
        )
        made.reset()
        return made
