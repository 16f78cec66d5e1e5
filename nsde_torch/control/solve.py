"""Iterations of a solver until a plan is good enough or time is up, compiled where that pays."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, final

import torch
from torch import Tensor

from nsde_torch.control.compiled import Function, NoCompiler, compile_ahead
from nsde_torch.control.gauss_newton import GaussNewton, Iterate
from nsde_torch.control.horizon import Horizon
from nsde_torch.errors import ConfigError
from nsde_torch.sde import CompilationWarning

Clock = Callable[[], float]


@dataclass(frozen=True)
class SolverOptions:
    """How plans are found.

    Args:
        name: Key in `SOLVERS`.
        iterations: Most iterations of a solve.
        tolerance: A plan is good enough when its `gap` is no more than this share of its cost.
        compile: "on", "off", or "auto": where one plan is made at a time.
        deadline: Time for a solve [s]; the best plan so far is returned when the next iteration would not fit. None:
            no deadline.
        cache: Folder of compiled packages; None: the package's cache.
    """

    name: str = "gauss_newton"
    iterations: int = 10
    tolerance: float = 1e-3
    compile: str = "auto"
    deadline: float | None = None
    cache: str | None = None

    def __post_init__(self) -> None:
        if self.iterations < 1 or not self.tolerance >= 0:
            raise ConfigError(
                f"`iterations` must be at least 1 and `tolerance` 0 or more; got {self.iterations!r}, "
                f"{self.tolerance!r}."
            )
        if self.compile not in ("auto", "on", "off"):
            raise ConfigError(f"`compile` must be auto, on or off; got {self.compile!r}.")
        if self.deadline is not None and not self.deadline > 0:
            raise ConfigError(f"`deadline` must be a time above 0 s; got {self.deadline!r}.")


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
        self._module = SOLVERS[options.name](horizon, batch)
        self.compiled = False
        self._iterate: Function = self._eager
        self._longest = 0.0
        if options.compile == "on" or (options.compile == "auto" and batch == 1):
            try:
                self._iterate = compile_ahead(
                    self._module,
                    self._example(batch),
                    name=options.name,
                    structure=self._module.structure,
                    folder=options.cache,
                    say=say,
                )
                self.compiled = True
            except NoCompiler as error:
                if options.compile == "on":
                    raise ConfigError(f"`compile=on`, but {error}. Use compile=off.") from error
                warnings.warn(
                    f"the solver runs without compilation, some thirty times slower: {error}.",
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
        memory = self._module.start(u)
        while True:
            begun = self._clock()
            out = self._iterate((problem.z0, u, z, problem.ref, problem.last, problem.d, *memory))
            step, memory = Iterate(*out[:5]), tuple(out[5:])
            u, z = step.u, step.z
            if not costs:
                costs.append(step.before)
            costs.append(step.cost)
            # what the quadratic could have saved and the model did not: of second order near the optimum
            gap = (step.promised - (step.before - step.cost)).abs() / step.cost.abs().clamp_min(1e-9)
            converged = gap <= o.tolerance
            now = self._clock()
            self._longest = max(0.9 * self._longest, now - begun)
            late = o.deadline is not None and now - started + self._longest > o.deadline
            if len(costs) > o.iterations or late or bool(converged.all()):
                break
        seconds = self._clock() - started
        return Solution(
            u=u,
            z=z,
            cost=step.cost,
            gap=gap,
            costs=tuple(costs),
            seconds=seconds,
            in_time=o.deadline is None or seconds <= o.deadline,
            converged=converged,
        )

    def _eager(self, arguments: Sequence[Tensor]) -> list[Tensor]:
        return list(self._module(*arguments))

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
        return (z0, u, z, ref, u[:, 0].clone(), torch.zeros(batch, h.nd, dtype=dtype), *self._module.start(u))


SOLVERS: dict[str, Callable[[Horizon, int], GaussNewton]] = {
    "gauss_newton": lambda horizon, batch: GaussNewton(horizon),
}
