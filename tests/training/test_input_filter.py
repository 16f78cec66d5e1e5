"""A model's input filter from inputs that were restored."""

from __future__ import annotations

import numpy as np
import torch

from nsde_torch.data import Run
from nsde_torch.models.input_filter import InputFilter
from nsde_torch.training.prepare import fit_filter

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
