"""The controller: measured state in, plan out, whatever happens.

    plan = solve from the last plan, shifted in time;  on trouble the last safe plan, shifted;  then hover (or rest)

A plan that leaves here is finite and within bounds. Its status says how it came about.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import acos, dist, hypot, isfinite
from typing import Any, Protocol, final

import numpy as np
import torch
from torch import Tensor

from nsde_torch.control.feasible import hover_input
from nsde_torch.control.options import SafetyOptions
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.problem import Horizon, ProblemOptions, problem_of
from nsde_torch.control.reference import at_rest
from nsde_torch.control.solve import Clock, Problem, Solution, Solver, SolverOptions
from nsde_torch.effects import Port
from nsde_torch.errors import ConfigError, ShapeError
from nsde_torch.models import Model
from nsde_torch.systems import Multirotor, System

CONVERGED, IMPROVED, LATE = "converged", "improved", "late"
BAD_STATE, JUMP, DIVERGED, BAD_REFERENCE = "bad_state", "state_jump", "diverged", "bad_reference"
KEPT, HOVER, REST = "kept", "hover", "rest"
"""Words of a status: how good a plan is, what was wrong, and what was done about it (`bad_state:kept`)."""

ANEW = 10
"""Solves between two that start at rest too, for machines that swing: a plan may stay beside an optimum and put off
what it would have to begin (a cart that balanced its pole 0.9 m from the set point)."""


@dataclass(frozen=True)
class Plan:
    """What the controller wants to do; one row per machine."""

    u: Tensor  # inputs (N, K, nu), finite and within bounds; u[:, k] holds from k dt to (k + 1) dt
    x: Tensor  # states that it expects, (N, K + 1, nx)
    cost: Tensor  # what it costs (N,); infinite for hovering
    gap: Tensor  # estimated share of the cost that a better plan would save (N,)
    status: tuple[str, ...]  # one word or two per row
    solve_ms: float  # time that it took
    iterations: int  # iterations of the solver
    dt: float  # step of the plan [s]
    age: Tensor  # time since it was solved for [s], (N,)
    z: Tensor  # states with memory (N, P, K + 1, nz), to start the next solve from

    def shifted(self, time: float) -> Plan:
        """The same plan, seen a time [s] later; its end is held."""
        steps = time / self.dt
        return replace(self, u=_shift(self.u, steps), z=_shift(self.z, steps, axis=2), age=self.age + time)


def word_at_rest(system: System) -> str:
    """What the last thing that is done about trouble is called."""
    return HOVER if isinstance(system, Multirotor) else REST


class Planner(Protocol):
    """What makes plans: a `Controller`, or a file that was made of one."""

    batch: int
    options: ProblemOptions
    hover: Tensor
    dtype: torch.dtype

    @property
    def predictor(self) -> Foresight:
        """What is known of the machine."""

    @property
    def plan(self) -> Callable[..., Plan]:
        """See `Controller.plan`."""


class Foresight(Protocol):
    """What predicts the state over one step: a `Predictor`, or a file that was made of one."""

    system: System
    dt: float
    nx: int
    nz: int
    nd: int
    ports: dict[Port, int]

    def __call__(self, z: Tensor, u: Tensor, d: Tensor) -> Tensor:
        """States after a step (N, nz), from states (N, nz), inputs (N, nu) and pushes (N, nd)."""

    def augment(self, x: Tensor, u: Tensor) -> Tensor:
        """States (N, nx) with the memory that is stationary under inputs (N, nu): (N, nz)."""


@final
class Controller:
    """Model predictive control of a machine.

    Args:
        model: What is known of the machine.
        problem: What a plan pays for; None: `problem_of` the machine.
        solver: How it is found.
        safety: When to reject a state or a plan.
        batch: Machines at a time.
        say: Called with one line when something takes long.
        clock: Time [s].

    Attributes:
        anew: Solves between two that start at rest too; 0: none does.

    Example:
        >>> controller = Controller(nsde_torch.load("runs/first"))  # doctest: +SKIP
        >>> plan = controller.plan(x, reference.window(t, dt=0.05, steps=20)[None])  # doctest: +SKIP
    """

    def __init__(
        self,
        model: Model | System,
        *,
        problem: ProblemOptions | None = None,
        solver: SolverOptions | None = None,
        safety: SafetyOptions | None = None,
        batch: int = 1,
        say: Callable[[str], None] | None = None,
        clock: Clock = time.perf_counter,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.options = problem or problem_of(model if isinstance(model, System) else model.system)
        self.safety = safety or SafetyOptions()
        self.predictor = Predictor(model, dt=self.options.dt, dtype=dtype)
        self.horizon = Horizon(self.predictor, self.options)
        self.solver = Solver(self.horizon, solver or SolverOptions(), batch=batch, say=say, clock=clock)
        self.batch, self.dtype = batch, dtype
        self.hover = hover_input(self.predictor).clamp(self.horizon.low, self.horizon.high)
        if not bool(torch.isfinite(self.hover).all()):
            raise ConfigError("the model has no hovering input: its rates are not finite. Train it anew.")
        self._jumped, self._solves = [0] * batch, 0
        self._rest, self._quaternion = word_at_rest(self.predictor.system), self.predictor.system.quaternion
        self.anew = ANEW if self._rest == REST else 0

    def hovering(self) -> Plan:
        """A plan that hovers, level and at the origin: what there is before the first solve."""
        n, o, system = self.batch, self.options, self.predictor.system
        u = self.hover.expand(n, o.steps, -1).contiguous()
        x = at_rest(system, self.dtype).repeat(n, 1)
        z = self.predictor.augment(x, u[:, 0])[:, None, None].repeat(1, o.particles, o.steps + 1, 1)
        nothing, status = u.new_full((n,), torch.inf), (self._rest,) * n
        return Plan(u, z[:, 0, :, : system.nx], nothing, nothing, status, 0.0, 0, o.dt, age=nothing, z=z)

    @torch.no_grad()
    def plan(
        self,
        x: Tensor,
        reference: Tensor,
        before: Plan | None = None,
        *,
        elapsed: float = 0.0,
        last: Tensor | None = None,
        push: Tensor | None = None,
        memory: Tensor | None = None,
    ) -> Plan:
        """Plan from measured states.

        Args:
            x: States (N, nx) at the time from which the plan holds.
            reference: States to track at the ends of the steps (N, K, nx).
            before: The plan before, to start from and to fall back on.
            elapsed: Time since that plan [s].
            last: Inputs that act now (N, nu); None: the first of the plan before.
            push: Disturbances on the force ports (N, nd); None: none.
            memory: Memory of the model's effects now (N, nz - nx); None: stationary under `last`.

        Raises:
            ShapeError: wrong axes or columns. Bad numbers raise nothing: see the status of the plan.
        """
        n, k, nx = self.batch, self.options.steps, self.predictor.nx
        x, reference = x.to(self.dtype), reference.to(self.dtype)
        if x.shape != (n, nx):
            raise ShapeError(f"`x` must be (batch={n}, nx={nx}); got {tuple(x.shape)}.")
        if reference.shape != (n, k, nx):
            raise ShapeError(
                f"`reference` must be (batch={n}, steps={k}, nx={nx}); got {tuple(reference.shape)}."
            )
        start = self.hovering() if before is None else before.shifted(elapsed)
        last = start.u[:, 0] if last is None else last.to(self.dtype)
        push = x.new_zeros(n, self.predictor.nd) if push is None else push.to(self.dtype)
        trouble = self._trouble(x, reference, start, known=before is not None)
        if before is None:
            self._solves = 0
        if any(trouble):
            bad = torch.tensor([word is not None for word in trouble])
            x = torch.where(bad[:, None], start.z[:, 0, 0, :nx], x)
            reference = torch.where(bad[:, None, None], start.z[:, 0, 1:, :nx], reference)
        if (at := self._quaternion) is not None:
            p, q, w = x.split((at.start, 4, nx - at.stop), 1)
            x = torch.cat((p, q / torch.linalg.vector_norm(q, dim=1, keepdim=True).clamp_min(1e-12), w), 1)
        z0 = self.predictor.augment(x, last) if memory is None else torch.cat((x, memory.to(self.dtype)), 1)
        if all(trouble):  # there is nothing to plan from
            found = self.solver.nothing(start.u, start.z)
        else:
            guess = self.horizon.rollout(z0, start.u, push) if before is None else start.z
            problem = Problem(z0.contiguous(), reference.contiguous(), last.contiguous(), push.contiguous())
            found = self.solver.solve(problem, start.u.contiguous(), guess.contiguous())
            self._solves += 1
            if self.anew and before is not None and self._solves % self.anew == 0:
                here = z0[:, None, None].expand_as(guess).contiguous()
                found = found.or_cheaper(self.solver.solve(problem, self.hovering().u, here))
        finite = np.isfinite(found.cost.numpy()) & np.isfinite(found.u.numpy()).all((1, 2))
        safe = [word is None and bool(good) for word, good in zip(trouble, finite, strict=True)]
        status = self._status(trouble, safe, found, start, known=before is not None)
        new, ms, count = torch.zeros(n, dtype=self.dtype), 1e3 * found.seconds, len(found.costs) - 1
        rows = (found.u, found.z[:, 0, :, :nx], found.cost, found.gap, status)
        made = Plan(*rows, solve_ms=ms, iterations=count, dt=self.options.dt, age=new, z=found.z)
        return made if all(safe) else self._mended(made, start, z0)

    def _status(
        self, trouble: list[str | None], safe: list[bool], found: Solution, start: Plan, *, known: bool
    ) -> tuple[str, ...]:
        """How each row's plan came about."""
        out = []
        for row, word in enumerate(trouble):
            if word is None and safe[row]:
                good = CONVERGED if bool(found.converged[row]) else IMPROVED
                out.append(good if found.in_time else f"{good}:{LATE}")
            else:
                usable = known and float(start.age[row]) <= self.safety.keep + 1e-6
                out.append(f"{word or DIVERGED}:{KEPT if usable else self._rest}")
        return tuple(out)

    def _mended(self, made: Plan, start: Plan, z0: Tensor) -> Plan:
        """A plan whose rows in trouble are those of the plan before, or hover where they are."""
        n, still = self.batch, self.hovering()
        kept, hover = (torch.tensor([w.endswith(done) for w in made.status]) for done in (KEPT, self._rest))
        known = torch.isfinite(z0).all(1).view(n, 1, 1, 1)
        stays = z0[:, None, None].expand_as(still.z)

        def choose(new: Tensor, old: Tensor, rest: Tensor) -> Tensor:
            shape = (n,) + (1,) * (new.ndim - 1)
            return torch.where(hover.view(shape), rest, torch.where(kept.view(shape), old, new))

        z = choose(made.z, start.z, torch.where(known, stays, still.z))
        u = choose(made.u, start.u, still.u).clamp(self.horizon.low, self.horizon.high)
        rest: dict[str, Any] = {
            k: choose(*(getattr(plan, k) for plan in (made, start, still))) for k in ("cost", "gap", "age")
        }
        return replace(made, u=u, x=z[:, 0, :, : self.predictor.nx], z=z, **rest)

    def _trouble(self, x: Tensor, reference: Tensor, start: Plan, *, known: bool) -> list[str | None]:
        """What is wrong with each row's state or reference, if anything."""
        s, nx = self.safety, self.predictor.nx
        sane = np.isfinite(reference.numpy()).all((1, 2))
        rows = zip(x.tolist(), start.z[:, 0, 0, :nx].tolist(), start.age.tolist(), strict=True)
        out: list[str | None] = []
        for row, (now, expected, age) in enumerate(rows):
            finite, far, at = all(map(isfinite, now)), False, self._quaternion
            if finite and at is not None:
                along = sum(a * b for a, b in zip(now[at], expected[at], strict=True))
                far = 2.0 * acos(min(abs(along), 1.0)) > s.jump_attitude
                far = far or (self._rest == HOVER and dist(now[:3], expected[:3]) > s.jump)
            self._jumped[row] = self._jumped[row] + 1 if known and finite and age <= s.keep and far else 0
            if not finite or (at is not None and abs(hypot(*now[at]) - 1.0) > s.quaternion):
                out.append(BAD_STATE)
            elif not sane[row]:
                out.append(BAD_REFERENCE)
            else:
                out.append(JUMP if 0 < self._jumped[row] < s.jump_samples else None)
        return out


def _shift(table: Tensor, steps: float, *, axis: int = 1) -> Tensor:
    """Rows at times later by a number of steps, between two of them by interpolation; the end is held."""
    n = table.shape[axis]
    steps = min(max(steps, 0.0), n - 1.0)
    whole = int(steps)
    end = table.narrow(axis, n - 1, 1)
    rows = torch.cat((table.narrow(axis, whole, n - whole), *[end] * (whole + 1)), axis)
    return torch.lerp(rows.narrow(axis, 0, n), rows.narrow(axis, 1, n), steps - whole)


def setpoints(plan: Plan, system: Multirotor, *, ahead: float) -> tuple[Tensor, Tensor]:
    """Body rates, FLU (N, K, 3) [rad/s], and thrust over mass (N, K) [m/s2] at the beginning of each step of a plan.

    They are for a controller of rates. The supplement's flights send these and not motor commands, because of latency:
    rates are reached late, and taken from `ahead` [s] on.
    """
    later = plan.shifted(max(ahead, 0.0))
    n, steps, _ = plan.u.shape
    thrust = system.quantity("thrust", plan.x[:, :-1].flatten(0, 1), plan.u.flatten(0, 1))
    return later.z[:, 0, :-1, 10:13], thrust[:, 0].view(n, steps)
