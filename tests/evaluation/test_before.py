"""Inputs before windows reach every rollout that is scored, fitted or shown."""

import numpy as np
import pytest
import torch

from nsde_torch.data import Run, Windows
from nsde_torch.evaluation.scores import rollout_squares, score
from nsde_torch.models import IdentifiedModel, SysidSpec
from tests.models.test_inputs_before import DT, VALUES, flight

STEPS = 10


@pytest.fixture(scope="module")
def windows() -> Windows:
    x, u = flight("motor_lag")
    t = DT * np.arange(len(x))
    commands = torch.cat((u, u[-1:])).numpy()
    return Windows([Run("a", t, x.numpy(), commands)], DT, STEPS, dtype=torch.float64)


def truth() -> IdentifiedModel:
    spec = SysidSpec("hexacopter", dt=DT, horizon=STEPS, effects=("motor_lag",))
    made = IdentifiedModel(spec, generator=torch.Generator(), values=VALUES["motor_lag"])
    return made.double().requires_grad_(False)


def test_the_true_model_is_scored_without_error_from_anywhere_in_a_run(windows: Windows) -> None:
    starts = torch.arange(25, len(windows), 4)
    scores = score(truth(), windows, starts, [5, STEPS], seed=0, particles=3)
    assert float(scores.squares.max()) < 1e-6
    squares = rollout_squares(truth(), windows, starts, [5, STEPS])
    assert float(squares.max()) < 1e-6
    x, u, _ = windows.batch(starts)
    stationary = truth().sample(x[:, 0], u, dt=DT, particles=1, generator=torch.Generator())
    assert float((stationary[0] - x).square().max()) > 1e-2
