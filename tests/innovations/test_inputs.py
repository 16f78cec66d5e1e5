"""A model's input filter from inputs that were restored, and what inputs that never move hold."""

from __future__ import annotations

import warnings

import numpy as np
import torch

from nsde_torch.data import Run
from nsde_torch.innovations.inputs import fit_filter
from nsde_torch.innovations.residuals import input_history
from nsde_torch.models.input_filter import InputFilter
from nsde_torch.sysid.series import Series

DT = 0.01


def run(u: np.ndarray, segments: list[tuple[int, int]]) -> Run:
    return Run("a", DT * np.arange(len(u)), np.zeros((len(u), 2)), u, segments=segments)


def test_segments_shorter_than_a_step_of_the_model_teach_the_filter_nothing() -> None:
    rng = np.random.default_rng(0)
    u = rng.normal(size=(400, 1))
    averaged = np.convolve(u[:, 0], np.ones(9) / 9.0, mode="same")[:, None]
    whole, pieces = [(0, 300)], [(0, 300), *((a, a + 4) for a in range(300, 400, 4))]
    weights = []
    for segments in (whole, pieces):
        target = InputFilter(2, 5 * DT)
        fit_filter(target, [run(averaged, segments)], [run(u, segments)], 1)
        weights.append(target.weights.detach().clone())
    assert weights[0].abs().max() > 0.1
    torch.testing.assert_close(weights[0], weights[1])


def test_inputs_that_never_move_have_no_history() -> None:
    rng = np.random.default_rng(1)
    moving = rng.normal(size=(200, 1))
    series = Series([(0, 100), (100, 200)])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for value in (0.0, 1.0, 0.1, 1e-4):
            still = np.full((200, 2), value)
            assert input_history(still, series).shape == (200, 0)
        assert input_history(np.column_stack((moving, still)), series).shape[1] > 0
