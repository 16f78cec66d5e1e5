"""What a rollout's paths are distributed as, whatever the step length."""

import math

import pytest
import torch
from scipy import stats

from nsde_torch.sde import STEPS, brownian, make_step, rollout
from tests.helpers.sde_problems import OrnsteinUhlenbeck, SharedSum

STOCHASTIC = [name for name, cls in STEPS.items() if not cls.deterministic]


@pytest.mark.parametrize("name", STOCHASTIC)
def test_ornstein_uhlenbeck_ends_in_its_normal_law(name: str) -> None:
    problem, steps = OrnsteinUhlenbeck(), 256
    noise = brownian(4000, 1, steps, 1, dt=1 / steps, generator=torch.Generator().manual_seed(4))
    z0, u = torch.ones(1, 1), torch.zeros(1, steps, 1)
    end = rollout(problem, z0, u, dt=1 / steps, step=make_step(name), noise=noise)[:, 0, -1, 0]
    spread = problem.sigma * math.sqrt((1 - math.exp(-2 * problem.rate)) / (2 * problem.rate))
    law = stats.norm(math.exp(-problem.rate), spread)
    assert stats.kstest(end.double().numpy(), law.cdf).pvalue > 1e-3


@pytest.mark.parametrize("name", STOCHASTIC)
def test_the_mean_on_coupled_noise_is_that_of_the_stated_calculus(name: str) -> None:
    step, steps = make_step(name), 64
    g = torch.Generator().manual_seed(6)
    noise = brownian(40000, 1, steps, 2, dt=1 / steps, generator=g, dtype=torch.float64)
    z0, u = torch.full((1, 2), 0.5, dtype=torch.float64), torch.zeros(1, steps, 1, dtype=torch.float64)
    mean = rollout(SharedSum(0.5), z0, u, dt=1 / steps, step=step, noise=noise)[:, 0, -1].sum(-1).mean()
    assert float(mean) == pytest.approx(1.0 if step.calculus == "ito" else math.exp(0.25), rel=0.02)
