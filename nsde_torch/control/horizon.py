"""Paths and costs of plans, many at once, as functions of plain tensors.

Rows are plans: N of them, each with P paths. Time runs through the one loop that cannot be avoided; all else is
evaluated for every step of every plan together.
"""

from __future__ import annotations

from dataclasses import replace
from typing import final

import torch
from torch import Tensor, nn

from nsde_torch.control.predictor import Predictor
from nsde_torch.control.problem import ProblemOptions, Residual


@final
class Horizon(nn.Module):
    """Discretised problem over a model.

    Args:
        predictor: One step of the model.
        options: What a plan pays for.

    Attributes:
        steps, nx, nu, nz, nd: Steps, states, inputs, states with memory, pushes.
        particles: Paths of a plan.
        noise: Increments of the paths (K, P, nx), zero for a single one.
    """

    def __init__(self, predictor: Predictor, options: ProblemOptions) -> None:
        super().__init__()
        self.predictor, self.options = predictor, options
        self.residual = Residual(predictor, options)
        self.steps, self.particles = options.steps, options.particles
        self.nx, self.nu, self.nz, self.nd = predictor.nx, predictor.nu, predictor.nz, predictor.nd
        self.noise: Tensor
        self.register_buffer("noise", _increments(options, self.nx, predictor.dtype))
        self.input_weight: Tensor
        self.input_centre: Tensor
        self.rate_weight: Tensor
        for name in ("input_weight", "input_centre", "rate_weight"):
            self.register_buffer(name, torch.tensor(getattr(options, name), dtype=predictor.dtype))

    @property
    def structure(self) -> str:
        """Every setting that is not a tensor, in words."""
        blank = replace(
            self.options, state_weights=(1.0,), input_weight=1.0, input_centre=0.0, rate_weight=0.0, seed=0
        )
        return f"{blank} {self.predictor.structure}"

    def advance(self, z: Tensor, u: Tensor, d: Tensor, noise: Tensor | None = None) -> Tensor:
        """States after a step (N, nz); `noise` (N, nx) are Brownian increments."""
        after = self.predictor(z, u, d)
        if noise is None:
            return after
        push = self.predictor.sigma(z[:, : self.nx]) * noise
        push = torch.cat((push, push.new_zeros(len(z), self.nz - self.nx)), 1) if self.nz > self.nx else push
        return self.predictor.system.project(after + push)

    def increments(self, k: int, rows: int) -> Tensor | None:
        """Noise of step k for that many plans (rows * P, nx), the paths of a plan together; None without noise."""
        if self.particles == 1:
            return None
        return self.noise[k].repeat(rows, 1)

    def rollout(self, z0: Tensor, u: Tensor, d: Tensor) -> Tensor:
        """States of plans.

        Args:
            z0: First states (N, nz).
            u: Inputs (N, K, nu).
            d: Pushes (N, nd), held.

        Returns:
            States (N, P, K + 1, nz).
        """
        n, p = len(u), self.particles
        z, d = _repeat(z0, p), _repeat(d, p)
        states = [z]
        for k in range(self.steps):
            z = self.advance(z, _repeat(u[:, k], p), d, self.increments(k, n))
            states.append(z)
        return torch.stack(states, 1).view(n, p, self.steps + 1, self.nz)

    def cost(self, z: Tensor, u: Tensor, ref: Tensor, last: Tensor) -> Tensor:
        """Costs of plans.

        Args:
            z: States (N, P, K + 1, nz).
            u: Inputs (N, K, nu).
            ref: References at the ends of the steps (N, K, nx).
            last: Inputs before the plan (N, nu).

        Returns:
            J (N,).
        """
        n, p, k = len(u), self.particles, self.steps
        x = z[:, :, 1:, : self.nx].reshape(n * p * k, self.nx)
        wanted = ref[:, None].expand(n, p, k, self.nx).reshape(n * p * k, self.nx)
        r = self.residual(x, wanted)
        return (r * r).reshape(n, -1).sum(1) / p + self.input_cost(u, last)

    def input_cost(self, u: Tensor, last: Tensor) -> Tensor:
        """What plans pay for their inputs (N,)."""
        centred, change = u - self.input_centre, torch.diff(u, dim=1, prepend=last[:, None])
        squares = self.input_weight * centred * centred + self.rate_weight * change * change
        return squares.flatten(1).sum(1)


def _repeat(x: Tensor, p: int) -> Tensor:
    return x if p == 1 else x.repeat_interleave(p, 0)


def _increments(options: ProblemOptions, nx: int, dtype: torch.dtype) -> Tensor:
    """Antithetic pairs: the mean of an even number of paths has no noise of the first order."""
    k, p = options.steps, options.particles
    if p == 1:
        return torch.zeros(k, 1, nx, dtype=dtype)
    generator = torch.Generator().manual_seed(options.seed)
    half = torch.randn(k, (p + 1) // 2, nx, generator=generator, dtype=torch.float64) * options.dt**0.5
    return torch.cat((half, -half), 1)[:, :p].to(dtype)
