"""Inputs before windows reach every rollout that is scored, fitted or shown."""

from typing import Any

import numpy as np
import pytest
import torch

from nsde_torch.data import Run, Windows
from nsde_torch.evaluation.scores import rollout_squares, score, squares_of, states_by_fold
from nsde_torch.models import IdentifiedModel, SysidSpec
from nsde_torch.systems.parameters import ParameterVector
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
    assert float(scores.squares["model"].max()) < 1e-6
    squares = rollout_squares(truth(), windows, starts, [5, STEPS])
    assert float(squares.max()) < 1e-6
    x, u, _ = windows.batch(starts)
    stationary = truth().sample(x[:, 0], u, dt=DT, particles=1, generator=torch.Generator())
    assert float((stationary[0] - x).square().max()) > 1e-2


@pytest.mark.parametrize("branches", [False, True])
def test_folds_predict_together_as_they_do_alone(
    branches: bool, windows: Windows, monkeypatch: pytest.MonkeyPatch
) -> None:
    if branches:  # as an effect of the user's own may
        plain = IdentifiedModel.drift

        def drift(self: IdentifiedModel, t: Any, z: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
            return plain(self, t, z, u) if bool((z[:, 3:6].abs() < 1e9).all()) else z

        monkeypatch.setattr(IdentifiedModel, "drift", drift)
    starts, steps, model = torch.arange(25, len(windows), 4), [5, STEPS], truth()
    fold = np.arange(len(starts)) * 5 // (2 * len(starts))  # of unlike sizes
    vector = ParameterVector(model.system)
    values = np.stack([vector.start, 1.02 * vector.start, 0.97 * vector.start])
    states = states_by_fold(truth(), windows, starts, steps, values=values, fold=fold)
    assert states.shape == (len(starts), 2, 13)
    together = squares_of(model.system, states, windows, starts, steps)
    for f, theta in enumerate(values):
        alone = truth()
        vector.write(alone.system, theta)
        expected = rollout_squares(alone, windows, starts[fold == f], steps)
        torch.testing.assert_close(together[fold == f], expected, rtol=1e-6, atol=1e-12)
    assert float(together[fold == 1].max()) > 1e-6 > float(together[fold == 0].max())
