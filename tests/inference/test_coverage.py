"""Intervals hold the truth as often as they say, over springs with dry friction of a simulator of its own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom, norm

from nsde_torch.inference import fit
from tests.inference.springs import TRUTH, rubbing, small_runs, spring

FRICTION = 0.2


@pytest.mark.slow
def test_standard_errors_hold_the_truth_as_often_as_they_say() -> None:
    truth, off = {**TRUTH, "coulomb_friction.size": FRICTION}, []
    for seed in range(10):
        found = fit(spring("coulomb_friction", values={}), small_runs(rubbing(FRICTION), 3, 15.0, seed=seed))
        assert found.objections == []
        at = [found.vector.labels.index(label) for label in truth]
        off.append((found.theta[at] - list(truth.values())) / found.standard_errors[at])
    away = np.abs(np.array(off)).reshape(-1)
    assert np.isfinite(away).all()
    # neither too narrow nor too wide: by chance outside these once in two hundred
    for share in (0.5, 0.9):
        inside = int((away < norm.ppf(0.5 + 0.5 * share)).sum())
        low, high = binom.ppf((0.0025, 0.9975), len(away), share)
        assert low <= inside <= high
