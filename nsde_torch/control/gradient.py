"""Accelerated projected gradient, the supplement's solver: one iteration, for many problems at once.

    y = u + beta (u - u_before)                               Nesterov's extrapolation
    u' = best of P(y - a s grad J(y)),  a = 4, 2, 1, 1/2, ... and u itself            P: projection on the box

(Nesterov 1983; Beck and Teboulle, SIAM J. Imaging Sci. 2, 2009, with the monotone choice and the restart of O'Donoghue
and Candes, Found. Comput. Math. 15, 2015.) The line search is parallel: all candidate steps are rolled out as one
batch, the best becomes the plan, and its step size is where the next search starts. The gradient comes from
the forward derivatives of all steps in one batch: a backward pass through the rollout takes minutes more to compile.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import final

import torch
from torch import Tensor, nn

from nsde_torch.control.gauss_newton import Function, GaussNewton, Iterate
from nsde_torch.control.horizon import Horizon, _repeat

FACTORS = (4.0, 2.0, 1.0, 0.5, 0.25, 0.06)
"""Steps that are tried, as multiples of the step before."""
FIRST_STEP = 1e-3


@final
class AcceleratedGradient(nn.Module):
    """An iteration in two stages, each from plain tensors to plain tensors.

    The memory between iterations is the plan before (N, K, nu), the momentum's counter (N,) and the step (N,).

    Args:
        horizon: The problem.

    Attributes:
        stages, fused: See `GaussNewton`.
    """

    stages = ("slope", "search")
    fused = ("search",)

    def __init__(self, horizon: Horizon) -> None:
        super().__init__()
        self.horizon = horizon
        self._newton = GaussNewton(horizon)  # for its linearisation
        self.factors: Tensor
        self.register_buffer("factors", torch.tensor(FACTORS, dtype=horizon.predictor.dtype))

    @property
    def structure(self) -> str:
        """Every setting that is not a tensor, in words."""
        return f"{FACTORS} {self.horizon.structure}"

    def start(self, u: Tensor) -> tuple[Tensor, ...]:
        """Memory before the first iteration."""
        one = u.new_ones(len(u))
        return u.clone(), one, FIRST_STEP * one

    def iterate(
        self,
        run: Mapping[str, Function],
        arguments: Sequence[Tensor],
        memory: tuple[Tensor, ...],
        tolerance: float,
    ) -> tuple[Iterate, tuple[Tensor, ...]]:
        """Improve plans; see `GaussNewton.iterate`."""
        z0, u, _, ref, last, d = arguments
        before, counter, size = memory
        y, gradient, later = run["slope"]([z0, u, ref, last, d, before, counter])
        out = run["search"]([z0, u, ref, last, d, y, gradient, later, size])
        return Iterate(*out[:6]), tuple(out[6:])

    def slope(
        self, z0: Tensor, u: Tensor, ref: Tensor, last: Tensor, d: Tensor, before: Tensor, counter: Tensor
    ) -> tuple[Tensor, ...]:
        """Extrapolated plans (N, K, nu), the gradient there, and the momentum's next counter (N,)."""
        o = self.horizon.options
        later = 0.5 * (1.0 + torch.sqrt(1.0 + 4.0 * counter * counter))
        y = (u + ((counter - 1.0) / later)[:, None, None] * (u - before)).clamp(o.low, o.high)
        return y, self.gradient(z0, y, ref, last, d), later

    def search(
        self,
        z0: Tensor,
        u: Tensor,
        ref: Tensor,
        last: Tensor,
        d: Tensor,
        y: Tensor,
        gradient: Tensor,
        later: Tensor,
        size: Tensor,
    ) -> tuple[Tensor, ...]:
        """Roll out steps of several sizes, and keep the best plan; returns an `Iterate`, then the memory."""
        h, o = self.horizon, self.horizon.options
        n, k, nu = len(u), h.steps, h.nu
        steps = size[:, None] * self.factors
        tried = (y[:, None] - steps[..., None, None] * gradient[:, None]).clamp(o.low, o.high)
        s = len(FACTORS) + 1
        candidates = torch.cat((tried, u[:, None]), 1).reshape(n * s, k, nu)
        paths = h.rollout(_repeat(z0, s), candidates, _repeat(d, s))
        costs = h.cost(paths, candidates, _repeat(ref, s), _repeat(last, s)).view(n, s)
        costs = torch.nan_to_num(costs, nan=torch.inf)
        best = costs.argmin(1)
        row = best[:, None, None]
        new = candidates.view(n, s, -1).gather(1, row.expand(n, 1, k * nu)).view(n, k, nu)
        path = paths.view(n, s, -1).gather(1, row.expand(n, 1, paths[0].numel())).view(n, *paths.shape[1:])
        cost = costs.gather(1, best[:, None])[:, 0]
        stuck = best == s - 1  # nothing was better: without momentum, and with shorter steps, from here
        chosen = (
            torch.cat((self.factors, self.factors[-1:])).expand(n, s).gather(1, best[:, None])[:, 0] * size
        )
        chosen = chosen.clamp(1e-7, 1.0)
        # the input terms alone curve J by 2 R, which bounds what is left by the projected gradient; a loose bound
        moved = (y - (y - gradient * chosen[:, None, None]).clamp(o.low, o.high)) / chosen[:, None, None]
        left = (moved * moved).flatten(1).sum(1) / (4.0 * h.input_weight).clamp_min(1e-6)
        gap = left / cost.abs().clamp_min(1e-9)
        counter = torch.where(stuck, torch.ones_like(later), later)
        kept = torch.where(stuck[:, None, None], new, u)
        return new, path, cost, costs[:, -1].clone(), gap, gap.max(), kept, counter, chosen

    def gradient(self, z0: Tensor, u: Tensor, ref: Tensor, last: Tensor, d: Tensor) -> Tensor:
        """Gradient of the costs (N, K, nu): slopes of all steps in one batch, put together backwards in time."""
        h = self.horizon
        n, p = len(u), h.particles
        _, r, a, b, c, e = self._newton.linearise(u, h.rollout(z0, u, d), ref, d)
        back, parts = r.new_zeros(n * p, 1, h.nz), []
        for k in reversed(range(h.steps)):
            row = r[:, k, None]
            parts.append(row @ e[:, k] + back @ b[:, k])
            back = row @ c[:, k] + back @ a[:, k]
        along = torch.cat(parts[::-1], 1).view(n, p, h.steps, h.nu).mean(1)
        return 2.0 * (along + self._newton.input_gradient(u, last).view(n, h.steps, h.nu))
