"""Predictions of all folds at once are those of each fold alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from nsde_torch.data import Run, Windows
from nsde_torch.evaluation.scores import rollout_squares, squares_of, states_by_fold
from nsde_torch.models import IdentifiedModel, SysidSpec
from nsde_torch.systems.parameters import ParameterVector
from tests.models.test_inputs_before import DT, VALUES, flight

STEPS = [5, 10]


def physics() -> IdentifiedModel:
    spec = SysidSpec("hexacopter", dt=DT, horizon=max(STEPS), effects=("motor_lag",))
    made = IdentifiedModel(spec, generator=torch.Generator(), values=VALUES["motor_lag"])
    return made.double().requires_grad_(False)


@pytest.mark.parametrize("branches", [False, True])
def test_folds_predict_together_as_they_do_alone(branches: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    x, u = flight("motor_lag")
    commands = torch.cat((u, u[-1:])).numpy()
    windows = Windows(
        [Run("a", DT * np.arange(len(x)), x.numpy(), commands)], DT, STEPS[-1], dtype=torch.float64
    )
    if branches:  # as an effect of the user's own may
        plain = IdentifiedModel.drift

        def drift(self: IdentifiedModel, t: Any, z: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
            return plain(self, t, z, u) if bool((z[:, 3:6].abs() < 1e9).all()) else z

        monkeypatch.setattr(IdentifiedModel, "drift", drift)
    starts, model = torch.arange(25, len(windows)), physics()
    fold = np.arange(len(starts)) * 5 // (2 * len(starts))  # of unlike sizes
    vector = ParameterVector(model.system)
    values = np.stack([vector.start, 1.02 * vector.start, 0.97 * vector.start])
    model = physics()
    states = states_by_fold(model, windows, starts, STEPS, values=values, fold=fold)
    assert states.shape == (len(starts), 2, 13)
    together = squares_of(model.system, states, windows, starts, STEPS)
    for f, theta in enumerate(values):
        alone = physics()
        vector.write(alone.system, theta)
        expected = rollout_squares(alone, windows, starts[fold == f], STEPS)
        torch.testing.assert_close(together[fold == f], expected, rtol=1e-6, atol=1e-12)
    assert float(together[fold == 1].max()) > 1e-6 > float(together[fold == 0].max())
