"""The methods of ordinary equations: order, and agreement with an independent solver."""

import pytest
import torch
from torch import Tensor
from torchdiffeq import odeint

from nsde_torch.sde import Time, make_step, rollout
from tests.helpers.sde_problems import slope


class Pendulum:
    """theta'' = -sin(theta) - 0.1 theta' + 0.3 cos(t) + u; its diffusion must not be asked for."""

    calculus = "either"

    def drift(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        time = torch.as_tensor(t, dtype=z.dtype)
        forcing = 0.3 * torch.cos(time) + u[:, 0]
        return torch.stack((z[:, 1], -torch.sin(z[:, 0]) - 0.1 * z[:, 1] + forcing), -1)

    def diffusion(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        raise AssertionError("a deterministic step evaluated the diffusion")

    def project(self, z: Tensor) -> Tensor:
        return z


def start() -> Tensor:
    return torch.tensor([[0.5, 0.0], [2.0, -1.0]], dtype=torch.float64)


def reference() -> Tensor:
    u = torch.full((2, 1), 0.2, dtype=torch.float64)
    times = torch.tensor([0.0, 2.0], dtype=torch.float64)
    return odeint(lambda t, z: Pendulum().drift(t, z, u), start(), times, rtol=1e-12, atol=1e-12)[-1]


def end(name: str, steps: int) -> Tensor:
    u = torch.full((2, steps, 1), 0.2, dtype=torch.float64)
    return rollout(Pendulum(), start(), u, dt=2 / steps, step=make_step(name), noise=None)[0, :, -1]


@pytest.mark.parametrize(("name", "order"), [("midpoint", 2.0), ("rk4", 4.0)])
def test_method_has_its_classical_order(name: str, order: float) -> None:
    counts = (20, 40, 80, 160)
    errors = [float((end(name, n) - reference()).abs().max()) for n in counts]
    assert slope(tuple(2 / n for n in counts), errors) == pytest.approx(order, abs=0.15)
    assert make_step(name).strong_order == order
