"""Accelerated projected gradient, the supplement's solver: one iteration, for many problems at once.

    y = u + beta (u - u_before)                               Nesterov's extrapolation
    u' = best of P(y - a s grad J(y)),  a = 4, 2, 1, 1/2, ... and u itself            P: projection on the box

(Nesterov 1983; Beck and Teboulle, SIAM J. Imaging Sci. 2, 2009, with the monotone choice and the restart of O'Donoghue
and Candes, Found. Comput. Math. 15, 2015.) The line search is parallel: all candidate steps are rolled out as one
batch, the best becomes the plan, and its step size is where the next search starts. The gradient is torch's autograd's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import final

import torch
from torch import Tensor, nn

from nsde_torch.control.gauss_newton import Function, Iterate
from nsde_torch.control.horizon import Horizon, _repeat

FACTORS = (4.0, 2.0, 1.0, 0.5, 0.25, 0.06)
"""Steps that are tried, as multiples of the step before."""
FIRST_STEP = 1e-3


@final
class AcceleratedGradient(nn.Module):
    """An iteration, `forward`: plain tensors in and out.

    The memory between iterations is the plan before (N, K, nu), the momentum's counter (N,) and the step (N,).

    Args:
        horizon: The problem.

    Attributes:
        stages: Names of the stages, of which there is one.
    """

    stages = ("forward",)
    fused = ()

    def __init__(self, horizon: Horizon) -> None:
        super().__init__()
        self.horizon = horizon
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

    def forward(
        self,
        z0: Tensor,
        u: Tensor,
        z: Tensor,
        ref: Tensor,
        last: Tensor,
        d: Tensor,
        before: Tensor,
        counter: Tensor,
        size: Tensor,
    ) -> tuple[Tensor, ...]:
        """Improve plans; arguments as in `GaussNewton.forward`, then the memory.

        Returns:
            See `Iterate`; then the memory.
        """
        h = self.horizon
        n, k, nu = len(u), h.steps, h.nu
        o = h.options
        later = 0.5 * (1.0 + torch.sqrt(1.0 + 4.0 * counter * counter))
        beta = (counter - 1.0) / later
        y = (u + beta[:, None, None] * (u - before)).clamp(o.low, o.high)
        gradient = self.gradient(z0, y, ref, last, d)
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
        # Lipschitz steps promise |u - P(u - s g)|^2 / s at least; a multiple of it stands for what is left
        chosen = (
            torch.cat((self.factors, self.factors[-1:])).expand(n, s).gather(1, best[:, None])[:, 0] * size
        )
        chosen = chosen.clamp(1e-7, 1.0)
        moved = (y - gradient * chosen[:, None, None]).clamp(o.low, o.high) - y
        promised = (moved * moved).flatten(1).sum(1) / chosen
        counter = torch.where(stuck, torch.ones_like(counter), later)
        kept = torch.where(stuck[:, None, None], new, u)
        gap = promised / cost.abs().clamp_min(1e-9)
        return new, path, cost, costs[:, -1].clone(), gap, gap.max(), kept, counter, chosen

    def iterate(
        self,
        run: Mapping[str, Function],
        arguments: Sequence[Tensor],
        memory: tuple[Tensor, ...],
        tolerance: float,
    ) -> tuple[Iterate, tuple[Tensor, ...]]:
        """Improve plans; see `GaussNewton.iterate`."""
        out = run["forward"]([*arguments, *memory])
        return Iterate(*out[:6]), tuple(out[6:])

    def gradient(self, z0: Tensor, u: Tensor, ref: Tensor, last: Tensor, d: Tensor) -> Tensor:
        """Gradient of the costs (N, K, nu)."""
        h = self.horizon
        with torch.enable_grad():
            free = u.detach().requires_grad_()
            total = h.cost(h.rollout(z0, free, d), free, ref, last).sum()
            (gradient,) = torch.autograd.grad(total, free)
        return gradient
