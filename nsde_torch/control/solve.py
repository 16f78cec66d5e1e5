"""Iterations of a solver until a plan is good enough or time is up, compiled where that pays."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, NamedTuple, final

import torch
from torch import Tensor

from nsde_torch.control.compiled import CompiledMethod, NoCompiler
from nsde_torch.control.gauss_newton import AcceleratedGradient, GaussNewton, Memory
from nsde_torch.control.options import SolverOptions
from nsde_torch.control.problem import Horizon
from nsde_torch.errors import ConfigError
from nsde_torch.sde import CompilationWarning

Clock = Callable[[], float]


class Problem(NamedTuple):
    """Plain tensors that a solve starts from."""

    z0: Tensor  # states with memory now (N, nz)
    ref: Tensor  # references at the ends of the steps (N, K, nx)
    last: Tensor  # inputs before the plan (N, nu)
    d: Tensor  # pushes (N, nd)


@dataclass(frozen=True)
class Solution:
    """Best plans found."""

    u: Tensor  # inputs (N, K, nu)
    z: Tensor  # states (N, P, K + 1, nz)
    cost: Tensor  # costs (N,)
    gap: Tensor  # estimated share of the cost that a better plan would save (N,)
    costs: tuple[Tensor, ...] = field(repr=False)  # after each iteration, the first those of the start (N,)
    seconds: float  # time that it took
    in_time: bool  # whether the deadline was kept
    converged: Tensor  # whether the tolerance was reached (N,)

    def or_cheaper(self, other: Solution) -> Solution:
        """Of each row the cheaper plan of two solves."""
        better = other.cost < self.cost

        def pick(mine: Tensor, theirs: Tensor) -> Tensor:
            return torch.where(better.view(-1, *(1,) * (mine.ndim - 1)), theirs, mine)

        names = ("u", "z", "cost", "gap", "converged")
        best: dict[str, Any] = {name: pick(getattr(self, name), getattr(other, name)) for name in names}
        seconds, in_time = self.seconds + other.seconds, self.in_time and other.in_time
        return replace(self, **best, seconds=seconds, in_time=in_time)


@final
@dataclass(eq=False)
class Solver:
    """Solves problems of one horizon; `compiled` says whether its iterations are machine code."""

    horizon: Horizon  # the problem
    options: SolverOptions  # how
    _: KW_ONLY
    batch: int = 1  # plans at a time
    say: Callable[[str], None] | None = None  # called with one line when something takes long (a compilation)
    clock: Clock = time.perf_counter  # time [s]; another one makes deadlines testable

    def __post_init__(self) -> None:
        options = self.options
        self._method: GaussNewton | AcceleratedGradient | CompiledMethod
        self._method = (GaussNewton if options.name == "gauss_newton" else AcceleratedGradient)(self.horizon)
        self.compiled = False
        self._longest = 0.0
        if options.compile == "on" or (options.compile == "auto" and self.batch == 1):
            try:
                self._method = CompiledMethod(self._method, options.name, folder=options.cache, say=self.say)
                self.compiled = True
            except NoCompiler as error:
                if options.compile == "on":
                    raise ConfigError(f"`compile=on`, but {error}. Use compile=off.") from error
                text = f"the solver runs without compilation, much slower: {error}."
                warnings.warn(text, CompilationWarning, stacklevel=2)

    @torch.no_grad()
    def solve(self, problem: Problem, u: Tensor, z: Tensor) -> Solution:
        """Improve plans.

        Args:
            u: Inputs to start from (N, K, nu), within bounds.
            z: States near those that they lead to (N, P, K + 1, nz).
        """
        o, started = self.options, self.clock()
        costs: list[Tensor] = []
        memory: Memory = ()
        while True:
            begun = self.clock()
            arguments = (problem.z0, u, z, problem.ref, problem.last, problem.d)
            step, memory = self._method.iterate(arguments, memory)
            u, z = step.u, step.z
            if not costs:
                costs.append(step.before)
            costs.append(step.cost)
            converged = float(step.worst) <= o.tolerance
            now = self.clock()
            self._longest = max(0.9 * self._longest, now - begun)
            late = o.deadline is not None and now - started + self._longest > o.deadline
            if len(costs) > o.iterations or late or converged:
                break
        seconds, dtype = now - started, self.horizon.predictor.dtype
        return Solution(
            u=u.to(dtype, copy=True),
            z=z.to(dtype, copy=True),
            cost=step.cost.to(dtype),
            gap=step.gap.to(dtype),
            costs=tuple(cost.to(dtype) for cost in costs),
            seconds=seconds,
            in_time=o.deadline is None or seconds <= o.deadline,
            converged=step.gap <= o.tolerance,
        )

    def nothing(self, u: Tensor, z: Tensor) -> Solution:
        """Plans as they are, without a solve."""
        nothing = u.new_full((len(u),), torch.inf)
        return Solution(u, z, nothing, nothing, (nothing,), 0.0, True, torch.zeros(len(u), dtype=torch.bool))
