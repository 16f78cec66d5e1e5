"""Equations with closed forms, or with a known limit, for the tests of the solvers."""

from typing import Literal, final

import torch
from torch import Tensor, nn

from nsde_torch.sde import Step, Time, brownian, coarsen, rollout

Calculus = Literal["ito", "stratonovich", "either"]


class Equation:
    """dz = f dt + g * dW, on all of space."""

    calculus: Calculus = "either"

    def project(self, z: Tensor) -> Tensor:
        return z


class Quiet(Equation):
    """dz = f dt."""

    def diffusion(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        return torch.zeros_like(z)


class Problem(Equation):
    """One whose `solution` z(t) at the time of W is known, given W and the calculus in which the star is read."""

    z0: float


@final
class GeometricBrownianMotion(Problem):
    """dz = a z dt + b z * dW: z0 exp((a - b^2 / 2) t + b W) for Ito, z0 exp(a t + b W) for Stratonovich."""

    def __init__(self, a: float = 0.5, b: float = 0.8, calculus: Calculus = "either") -> None:
        self.a, self.b, self.calculus, self.z0 = a, b, calculus, 1.0

    def drift(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        return self.a * z

    def diffusion(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        return self.b * z

    def solution(self, t: float, w: Tensor, calculus: str) -> Tensor:
        rate = self.a - (0.5 * self.b**2 if calculus == "ito" else 0.0)
        return self.z0 * torch.exp(rate * t + self.b * w)


@final
class SquareRoot(Problem):
    """dz = b sqrt(z) o dW, or dz = b^2 / 4 dt + b sqrt(z) dW: z = (sqrt(z0) + b W / 2)^2."""

    def __init__(self, calculus: Literal["ito", "stratonovich"], b: float = 0.5) -> None:
        self.b, self.calculus, self.z0 = b, calculus, 9.0

    def drift(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        return torch.full_like(z, self.b**2 / 4 if self.calculus == "ito" else 0.0)

    def diffusion(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        return self.b * z.sqrt()

    def solution(self, t: float, w: Tensor, calculus: str) -> Tensor:
        return (self.z0**0.5 + 0.5 * self.b * w) ** 2


@final
class DistanceAware(Equation):
    """Coupled diagonal noise, g_i = s sqrt(1 + |z|^2): every channel's sigma depends on all of z."""

    def __init__(self, s: float = 0.5, calculus: Calculus = "either") -> None:
        self.s, self.calculus = s, calculus

    def drift(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        return -0.5 * z

    def diffusion(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        return self.s * (1.0 + (z * z).sum(-1, keepdim=True)).sqrt().expand_as(z)


@final
class SharedSum(Equation):
    """dz_i = s (z_1 + ... + z_n) * dW_i: E sum(z) stays (Ito) or grows, exp(n s^2 t / 2) (Stratonovich)."""

    def __init__(self, s: float = 0.5) -> None:
        self.s = s

    def drift(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        return torch.zeros_like(z)

    def diffusion(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        return self.s * z.sum(-1, keepdim=True).expand_as(z)


@final
class SmallNetwork(nn.Module):
    """A neural equation with time, input, coupled noise, and a circle for its first two states."""

    calculus: Calculus = "either"

    def __init__(self, nz: int = 3, nu: int = 2) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.first = nn.Parameter(0.5 * torch.randn(8, nz + nu, generator=generator))
        self.second = nn.Parameter(0.5 * torch.randn(nz, 8, generator=generator))
        self.eta = nn.Parameter(0.5 * torch.randn(nz, nz, generator=generator))

    def drift(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        phase = (t if isinstance(t, Tensor) else torch.as_tensor(t, dtype=z.dtype)).reshape(-1, 1)
        return torch.tanh(torch.cat((z, u), -1) @ self.first.T) @ self.second.T + 0.1 * torch.sin(phase)

    def diffusion(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        return 0.3 * torch.sigmoid(z @ self.eta.T)

    def project(self, z: Tensor) -> Tensor:
        circle = z[:, :2]
        return torch.cat((circle / circle.norm(dim=-1, keepdim=True), z[:, 2:]), -1)


def strong_errors(
    problem: Problem, step: Step, *, paths: int, finest: int, factors: tuple[int, ...]
) -> list[float]:
    """Mean error at t = 1 on steps of factor / finest, on one Brownian path each, coarsened by summing."""
    generator = torch.Generator().manual_seed(1)
    fine = brownian(paths, 1, finest, 2, dt=1.0 / finest, generator=generator, dtype=torch.float64)
    exact = problem.solution(1.0, fine.sum(2), step.calculus)
    z0 = torch.full((1, 2), problem.z0, dtype=torch.float64)
    errors = []
    for factor in factors:
        dw = coarsen(fine, factor)
        u = z0.new_zeros(1, dw.shape[2], 1)
        end = rollout(problem, z0, u, dt=factor / finest, step=step, noise=dw)[:, :, -1]
        errors.append(float((end - exact).abs().mean()))
    return errors


def slope(steps: tuple[float, ...] | tuple[int, ...], errors: list[float]) -> float:
    """Slope of log error over log step, by least squares."""
    x, y = torch.tensor(steps, dtype=torch.float64).log(), torch.tensor(errors, dtype=torch.float64).log()
    x = x - x.mean()
    return float((x * y).sum() / (x * x).sum())
