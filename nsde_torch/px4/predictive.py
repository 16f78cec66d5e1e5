"""The predictive controller for PX4: body rates and thrust out of its plan.

A plan of motor commands from the newest state gives states x_k and inputs u_k at the ends of its steps. PX4 is sent

    rates(t) = omega(x, t + lead),      thrust(t) = thrust(u, t + lead) / mass,

earlier by `lead`, the time in which the rate loop, the motors and the line follow. What lasts and the model does not
know moves the reference, p_ref + trim with trim' = (p_ref - p) / T.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import torch

from nsde_torch.control.controller import HOVER, Controller, SafetyOptions
from nsde_torch.control.controller import Plan as MotorPlan
from nsde_torch.control.knowledge import knowledge
from nsde_torch.control.problem import ProblemOptions
from nsde_torch.control.reference import FlightPath, Reference
from nsde_torch.control.solve import SolverOptions
from nsde_torch.errors import ConfigError
from nsde_torch.plants.machines import Effects
from nsde_torch.px4.controller import Demand, Plan
from nsde_torch.px4.path import PAUSE
from nsde_torch.systems import Multirotor

TRIM_TIME, TRIM_LIMIT = 3.0, 0.3
"""Time constant [s] and largest size [m] of the trim."""
WARM_UP = 20
SLOWEST = 0.1
"""Longest time of a plan with which a vehicle can be flown, as the median of the warm-up [s]."""


@final
class PredictiveController:
    """Plans with a model; see `nsde_torch.px4.controller.Controller`.

    Args:
        controller: The solver and what it pays for; batch of one.
        reference: Where to fly.
        lead: How much earlier than the plan says rates and thrust are asked for [s].

    Raises:
        ConfigError: the model is of no multirotor.
    """

    def __init__(self, controller: Controller, reference: Reference, *, lead: float) -> None:
        system = controller.predictor.system
        if not isinstance(system, Multirotor):
            raise ConfigError(f"PX4 flies multirotors; the model is of a {system.name!r}.")
        self.controller, self.reference, self._lead = controller, reference, lead
        self._system = system
        self._last: tuple[float, MotorPlan] | None = None
        self._trim = torch.zeros(3, dtype=torch.float64)

    def reset(self) -> None:
        """Forget the last flight."""
        self._last = None
        self._trim = torch.zeros(3, dtype=torch.float64)

    @torch.no_grad()
    def __call__(self, row: tuple[float, ...], time: float, t: float) -> Plan:
        """See `Controller`."""
        started = clock.perf_counter()
        c, o = self.controller, self.controller.options
        x = torch.tensor([row], dtype=torch.float64)
        window = self.reference.window(t, dt=o.dt, steps=o.steps)
        elapsed = 0.0 if self._last is None else time - self._last[0]
        if abs(elapsed) > PAUSE:
            self.reset()
        elapsed = max(elapsed, 0.0)  # clocks are compared anew now and then, and a state may seem the older
        if t > 0.0:
            wanted = self.reference.at(torch.tensor(t))[:3]
            self._trim = self._trim + (wanted - x[0, :3]) * (min(elapsed, 0.1) / TRIM_TIME)
            self._trim = self._trim.clamp(-TRIM_LIMIT, TRIM_LIMIT)
        window[:, :3] += self._trim
        before = None if self._last is None else self._last[1]
        plan = c.plan(x, window[None], before, elapsed=elapsed)
        self._last = (time, plan)
        status = f"{plan.status[0]}: failed" if plan.status[0].endswith(HOVER) else plan.status[0]
        took = 1e3 * (clock.perf_counter() - started)
        return Plan(time - self._lead, plan.dt, self._demands(plan), status, took)

    def _demands(self, plan: MotorPlan) -> tuple[Demand, ...]:
        x, u = plan.x[0], plan.u[0]
        thrust = self._system.quantity("thrust", x[:-1], u)[:, 0].tolist()
        rates = x[:-1, 10:13].tolist()
        return tuple(Demand((w[0], w[1], w[2]), a) for w, a in zip(rates, thrust, strict=True))


@dataclass(frozen=True)
class PredictiveMaker:
    """Makes the controller in the process that it runs in; everything in it can be sent there.

    Args:
        run: Run directory of a model, or `declared`: the declared physics of `system` with its plant's values.
        system: Name of the machine.
        path: Where to fly.
        problem: What a plan pays for.
        solver: How it is found.
        safety: When to disbelieve.
        lead: See `PredictiveController`.
        effects: Effects beside the declared ones, for `declared`.
        threads: Threads of torch.
    """

    run: str
    system: str
    path: FlightPath
    problem: ProblemOptions
    solver: SolverOptions
    safety: SafetyOptions
    lead: float
    effects: Effects = ()
    threads: int = 1

    def __call__(self, say: Callable[[str], None]) -> PredictiveController:
        """Load, compile, and solve some times, so that the first plan in flight is none of a cold start.

        Args:
            say: Takes a line about what takes long.

        Raises:
            ConfigError: plans take too long to fly on.
        """
        torch.set_num_threads(self.threads)
        known = knowledge(self.run, self.system, effects=self.effects)
        controller = Controller(known, problem=self.problem, solver=self.solver, safety=self.safety, say=say)
        reference = Reference(self.path)
        made = PredictiveController(controller, reference, lead=self.lead)
        row = tuple(reference.at(torch.tensor(0.0)).tolist())
        took = sorted(made(row, 0.02 * k, 0.0).solve_ms for k in range(WARM_UP))[WARM_UP // 2]
        how = "compiled" if controller.solver.compiled else "not compiled"
        if took > 1e3 * SLOWEST:
            raise ConfigError(
                f"a plan takes {took:.0f} ms (solver {how}); at most {1e3 * SLOWEST:.0f} ms can be flown on. Install a "
                "C++ compiler (g++), or make plans shorter: mpc.steps, mpc.iterations."
            )
        say(f"the controller plans in {took:.1f} ms ({how})")
        return PredictiveController(controller, reference, lead=self.lead)
