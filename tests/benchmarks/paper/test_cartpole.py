"""Checks of the paper's figures follow the models and the numbers: cartpole, spring and policies."""

import math

import numpy as np
import torch

from nsde_benchmarks.paper.cartpole import uncertainty_map
from nsde_torch.data import Run
from nsde_torch.models import NeuralSDE, SDESpec


def episodes(count: int, seed: int) -> list[Run]:
    rng = np.random.default_rng(seed)
    t = 0.02 * np.arange(201)
    out = []
    for k in range(count):
        x = np.zeros((201, 4))
        x[:, 0] = 0.3 * np.sin(2 * t + k)
        x[:, 1] = 0.6 * np.cos(2 * t + k)
        x[:, 2] = math.pi + 0.5 * np.sin(3 * t + rng.uniform())
        x[:, 3] = 1.5 * np.cos(3 * t)
        out.append(Run(f"episode_{seed}_{k}", t, x, rng.uniform(-5, 5, (201, 1))))
    return out


def model(seed: int = 0) -> NeuralSDE:
    spec = SDESpec("cartpole", dt=0.02, horizon=10, step="euler_maruyama")
    return NeuralSDE(spec, generator=torch.Generator().manual_seed(seed))


def test_a_model_that_knows_nothing_of_the_data_fails_the_map() -> None:
    blind = model()
    with torch.no_grad():
        for parameter in blind.eta.parameters():
            parameter.zero_()
    outcome = uncertainty_map(blind, episodes(2, 0), episodes(1, 1), data_name="test data", seed=0)
    assert outcome.checks[0].passed is False
    assert set(outcome.figures) == {"map"}
    assert "test data" in outcome.title


def test_a_model_that_knows_the_data_passes_the_map() -> None:
    knowing = model()

    def distance(x: torch.Tensor) -> torch.Tensor:
        return torch.sigmoid(x[:, 1].abs() + x[:, 3].abs() - 3.0)

    knowing.distance = distance  # type: ignore[method-assign]
    outcome = uncertainty_map(knowing, episodes(2, 0), episodes(1, 1), data_name="test data", seed=0)
    assert outcome.values["sigma_theta_dot"]["away"] > outcome.values["sigma_theta_dot"]["held_out"]
    assert outcome.values["auroc"] > 0.6
