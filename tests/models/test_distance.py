"""The distance eta, the distance losses, and the diffusion that eta drives."""

import pytest
import torch
from torch import Tensor

from nsde_torch.models.networks import Diffusion, Distance
from nsde_torch.training.losses import distance_losses, draw_ball
from tests.helpers.draws import generator


def make_distance(n: int = 3, seed: int = 0, dtype: torch.dtype = torch.float64) -> Distance:
    eta = Distance(n, (32, 32), (8, 8), generator=generator(seed)).to(dtype)
    with torch.no_grad():  # nothing at its first value, so that a forgotten term shows
        for p in eta.parameters():
            p.add_(0.3 * torch.randn(p.shape, generator=generator(seed + 1), dtype=dtype))
    return eta


@pytest.mark.parametrize("kind", ["replay", "paper"])
def test_distance_losses_equal_those_written_with_autograd(kind: str) -> None:
    eta = make_distance()
    with torch.no_grad():
        eta.standardise.fit(5 + 2 * torch.randn(50, 3, generator=generator(5), dtype=torch.float64))
    features = 5 + 2 * torch.randn(10, 3, generator=generator(3), dtype=torch.float64)
    directions, share = draw_ball(10, 4, 3, generator(4), features)
    near, far = 0.2, 8.0
    losses = distance_losses(eta, features, directions, share, kind=kind, near=near, far=far)
    gradient, convexity, reward = (float(loss.detach()) for loss in losses)

    def height(y: Tensor) -> Tensor:
        energy = eta.energy(y)
        return eta.link(energy) if kind == "paper" else energy

    y = eta.standardise(features).requires_grad_()
    (slope,) = torch.autograd.grad(height(y).sum(), y)
    y = y.detach()
    bend, total = torch.zeros(10, 4, dtype=torch.float64), 0.0
    for i in range(10):
        mu = float(eta.mu(y[i : i + 1]).detach())
        total += 1.0 / mu
        for j in range(4):
            s = float(share[i, j])
            radius = near * s ** (1 / 3) if kind == "paper" else near * (far / near) ** s
            step = directions[i, j] * radius
            lower = height(y[i : i + 1]) + slope[i] @ step + 0.5 * mu * step @ step
            bend[i, j] = torch.relu(lower - height((y[i] + step)[None]))[0].detach()
    assert gradient == pytest.approx(float(slope.square().sum(1).mean()), rel=1e-9)
    assert convexity == pytest.approx(float(bend.square().mean()), rel=1e-9)
    assert reward == pytest.approx(total / 10, rel=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_eta_lies_between_zero_and_one_for_any_weights(seed: int) -> None:
    eta = make_distance(seed=seed, dtype=torch.float32)
    with torch.no_grad():
        for p in eta.parameters():
            p.mul_(5.0)
        value = eta(100 * torch.randn(1000, 3, generator=generator(seed)))
    assert float(value.min()) >= 0
    assert float(value.max()) <= 1
    assert value.shape == (1000,)


def test_logit_of_eta_stays_finite_and_ordered_far_from_the_data_in_float32() -> None:
    energy = torch.logspace(-2, 6, 60)
    for signed in (energy, -energy.flip(0)):
        logit = torch.logit(Distance.link(signed))
        assert bool(torch.isfinite(logit).all())
        assert bool((logit.diff() > 0).all())


@pytest.mark.parametrize("seed", range(5))
def test_h_rises_with_eta_on_every_channel_for_any_weights(seed: int) -> None:
    h = Diffusion(torch.tensor([0.1, 2.0, 30.0]), learned=True).double()
    with torch.no_grad():
        for p in (h.slope, h.offset):
            p.copy_(3 * torch.randn(3, generator=generator(seed), dtype=torch.float64))
        share = h.share(torch.linspace(0, 1, 50, dtype=torch.float64))
    assert share.shape == (50, 3)
    assert bool((share.diff(dim=0) > 0).all())
    assert float(share.min()) >= 0
    assert float(share.max()) <= 1
