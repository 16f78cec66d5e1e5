"""Data losses: the fair CRPS, what it is minimised by, and what the paper's loss is minimised by."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from nsde_torch.errors import ConfigError
from nsde_torch.evaluation.scores import crps
from nsde_torch.sde import brownian
from nsde_torch.training import LossOptions
from nsde_torch.training.losses import data_loss, paired_score
from tests.helpers.draws import generator
from tests.helpers.toy_systems import DT, Decay, decay_runs, fix_sigma, make_model

SCORES = [(crps, 2), (crps, 5), (paired_score, 2), (paired_score, 4), (paired_score, 6)]
Score = Callable[[Tensor], Tensor]


@pytest.mark.parametrize(("score", "particles"), SCORES)
@pytest.mark.parametrize(("mean", "sigma"), [(0.0, 1.0), (0.7, 0.4), (-2.0, 1.5)])
def test_the_expected_score_is_the_crps_of_the_gaussian_and_if_paired_the_error_of_its_mean_too(
    score: Score, particles: int, mean: float, sigma: float
) -> None:
    n, paired = 200_000, score is paired_score
    rows = particles // 2 if paired else particles
    draw = sigma * torch.randn(rows, n, generator=generator(particles), dtype=torch.float64)
    found = score(mean + (torch.cat((draw, -draw)) if paired else draw))
    z = -mean / sigma
    density = math.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)
    share = 0.5 * (1 + math.erf(z / math.sqrt(2)))
    expected = sigma * (z * (2 * share - 1) + 2 * density - 1 / math.sqrt(math.pi)) + paired * abs(mean)
    assert float(found.mean()) == pytest.approx(expected, abs=4 * float(found.std()) / math.sqrt(n))


def losses_over_sigma(kind: str, factors: list[float], particles: int) -> list[float]:
    """Data loss of a model with the right drift and `factor` times the right sigma, on one noise."""
    sigma, horizon, batch = 0.5, 20, 3000
    model = fix_sigma(make_model(Decay), sigma)
    x = torch.tensor(decay_runs(1, batch * horizon * DT, sigma=sigma)[0].x[:, 0], dtype=torch.float32)
    windows = torch.stack([x[k * horizon : (k + 1) * horizon + 1] for k in range(batch)])[..., None]
    noise = brownian(max(1, particles // 2), batch, horizon, 1, dt=DT, generator=generator(1))
    noise = torch.cat((noise, -noise))[:particles]
    u = torch.zeros(batch, horizon, 1)
    scores = []
    with torch.no_grad():
        for factor in factors:
            fix_sigma(model, max(sigma * factor, 1e-12))
            path = model.paths(windows[:, 0], u, dt=DT, noise=noise)
            errors, given = path[:, :, 1:] - windows[:, 1:], {"early": 0.5, "paired": kind == "replay"}
            scores.append(float(data_loss(errors, torch.ones(1), kind=kind, **given)))
    return scores


def test_default_loss_is_smallest_at_the_true_sigma() -> None:
    factors = [0.0, 0.5, 0.7, 0.85, 1.0, 1.15, 1.4, 2.0]
    scores = losses_over_sigma("replay", factors, particles=4)
    assert factors[scores.index(min(scores))] in (0.85, 1.0, 1.15)
    below, above = scores[:4], scores[5:]
    assert below == sorted(below, reverse=True)
    assert above == sorted(above)


def test_paper_loss_is_smallest_without_any_spread() -> None:
    scores = losses_over_sigma("paper", [0.0, 0.3, 0.6, 1.0, 1.5], particles=1)
    assert scores == sorted(scores)
    assert scores[3] > 1.5 * scores[0]


@pytest.mark.parametrize("early", [0.0, 0.5, 2.0])
def test_weights_of_the_steps_fall_as_a_power_and_average_one(early: float) -> None:
    horizon = 6
    alone = []
    for k in range(horizon):
        e = torch.zeros(2, 4, horizon, 1)
        e[:, :, k] = 3.0  # both particles: the spread is zero, the score is the error
        alone.append(float(data_loss(e, torch.ones(1), kind="replay", early=early, paired=False)))
    assert sum(alone) == pytest.approx(3.0, rel=1e-5)
    for k, value in enumerate(alone):
        assert value / alone[0] == pytest.approx((k + 1) ** -early, rel=1e-5)


def test_default_loss_refuses_one_particle_and_an_unknown_kind() -> None:
    with pytest.raises(ConfigError, match=r"loss.particles.*at least 2"):
        LossOptions(kind="replay", particles=1)
    with pytest.raises(ConfigError, match=r"loss.kind.*'crps'"):
        LossOptions(kind="crps")
