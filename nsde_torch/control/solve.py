"""Iterations of a solver until a plan is good enough or time is up, compiled where that pays."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, final

import torch
from torch import Tensor, nn

from nsde_torch.control.compiled import Function, NoCompiler, Stage, compile_ahead
from nsde_torch.control.gauss_newton import LEFT, AcceleratedGradient, GaussNewton
from nsde_torch.control.options import SolverOptions
from nsde_torch.control.problem import Horizon
from nsde_torch.errors import ConfigError
from nsde_torch.sde import CompilationWarning

Clock = Callable[[], float]


class Problem(NamedTuple):
    """Plain tensors that a solve starts from.

    Args:
        z0: States with memory now (N, nz).
        ref: References at the ends of the steps (N, K, nx).
        last: Inputs before the plan (N, nu).
        d: Pushes (N, nd).
    """

    z0: Tensor
    ref: Tensor
    last: Tensor
    d: Tensor


@dataclass(frozen=True)
class Solution:
    """Best plans found.

    Args:
        u: Inputs (N, K, nu).
        z: States (N, P, K + 1, nz).
        cost: Costs (N,).
        gap: Estimated share of the cost that a better plan would save (N,).
        costs: Costs after each iteration, the first those of the start (iterations + 1, N).
        seconds: Time that it took.
        in_time: Whether the deadline was kept.
        converged: Whether the tolerance was reached (N,).
    """

    u: Tensor
    z: Tensor
    cost: Tensor
    gap: Tensor
    costs: tuple[Tensor, ...] = field(repr=False)
    seconds: float
    in_time: bool
    converged: Tensor


@final
class Solver:
    """Solves problems of one horizon.

    Args:
        horizon: The problem.
        options: How.
        batch: Plans at a time.
        say: Called with one line when something takes long (a compilation).
        clock: Time [s]; another one makes deadlines testable.

    Attributes:
        compiled: Whether iterations are machine code.
    """

    def __init__(
        self,
        horizon: Horizon,
        options: SolverOptions,
        *,
        batch: int = 1,
        say: Callable[[str], None] | None = None,
        clock: Clock = time.perf_counter,
    ) -> None:
        if options.name not in SOLVERS:
            raise ConfigError(f"`solver` must be one of {', '.join(SOLVERS)}; got {options.name!r}.")
        self.horizon, self.options, self._clock = horizon, options, clock
        self._method = SOLVERS[options.name](horizon)
        self._stages: dict[str, Function] = {name: _eager(self._method, name) for name in self._method.stages}
        self.compiled = False
        self._longest = 0.0
        if options.compile == "on" or (options.compile == "auto" and batch == 1):
            try:
                self._stages = self._compiled(batch, say)
                self.compiled = True
            except NoCompiler as error:
                if options.compile == "on":
                    raise ConfigError(f"`compile=on`, but {error}. Use compile=off.") from error
                warnings.warn(
                    f"the solver runs without compilation, much slower: {error}.",
                    CompilationWarning,
                    stacklevel=2,
                )

    @torch.no_grad()
    def solve(self, problem: Problem, u: Tensor, z: Tensor) -> Solution:
        """Improve plans.

        Args:
            problem: What to solve.
            u: Inputs to start from (N, K, nu), within bounds.
            z: States near those that they lead to (N, P, K + 1, nz).
        """
        o, started = self.options, self._clock()
        costs: list[Tensor] = []
        memory = self._method.start(u)
        while True:
            begun = self._clock()
            arguments = (problem.z0, u, z, problem.ref, problem.last, problem.d)
            step, memory = self._method.iterate(self._stages, arguments, memory, LEFT)
            u, z = step.u, step.z
            if not costs:
                costs.append(step.before)
            costs.append(step.cost)
            converged = float(step.worst) <= o.tolerance
            now = self._clock()
            self._longest = max(0.9 * self._longest, now - begun)
            late = o.deadline is not None and now - started + self._longest > o.deadline
            if len(costs) > o.iterations or late or converged:
                break
        seconds = now - started
        return Solution(
            u=u,
            z=z,
            cost=step.cost,
            gap=step.gap,
            costs=tuple(costs),
            seconds=seconds,
            in_time=o.deadline is None or seconds <= o.deadline,
            converged=step.gap <= o.tolerance,
        )

    def nothing(self, u: Tensor, z: Tensor) -> Solution:
        """Plans as they are, without a solve."""
        nothing = u.new_full((len(u),), torch.inf)
        return Solution(u, z, nothing, nothing, (nothing,), 0.0, True, torch.zeros(len(u), dtype=torch.bool))

    def _compiled(self, batch: int, say: Callable[[str], None] | None) -> dict[str, Function]:
        """The stages as machine code."""
        seen: dict[str, list[Tensor]] = {}

        def watched(name: str) -> Function:
            def run(arguments: Sequence[Tensor]) -> list[Tensor]:
                seen.setdefault(name, [a.contiguous() for a in arguments])
                return self._stages[name](arguments)

            return run

        example = self._example(batch)
        with torch.no_grad():
            self._method.iterate({n: watched(n) for n in self._stages}, example[:6], example[6:], 0.0)
        return {
            name: compile_ahead(
                Stage(self._method, name),
                seen[name],
                name=f"{self.options.name}-{name}",
                structure=self._method.structure,
                fused=name in self._method.fused,
                folder=self.options.cache,
                say=say,
            )
            for name in self._stages
        }

    def _example(self, batch: int) -> tuple[Tensor, ...]:
        h = self.horizon
        o, dtype = h.options, h.predictor.dtype
        u = torch.full((batch, h.steps, h.nu), 0.5 * (o.low + o.high), dtype=dtype)
        x = torch.zeros(batch, h.nx, dtype=dtype)
        if h.predictor.system.quaternion is not None:
            x[:, h.predictor.system.quaternion.start] = 1.0
        z0 = h.predictor.augment(x, u[:, 0]).contiguous()
        z = z0[:, None, None].repeat(1, h.particles, h.steps + 1, 1)
        ref = x[:, None].repeat(1, h.steps, 1)
        return (z0, u, z, ref, u[:, 0].clone(), torch.zeros(batch, h.nd, dtype=dtype), *self._method.start(u))


def _eager(method: nn.Module, name: str) -> Function:
    return lambda arguments: list(getattr(method, name)(*arguments))


SOLVERS: dict[str, Callable[[Horizon], GaussNewton | AcceleratedGradient]] = {
    "gauss_newton": GaussNewton,
    "apg": AcceleratedGradient,
}
