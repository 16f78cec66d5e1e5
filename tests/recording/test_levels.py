"""Significance levels: one alpha for all stages, whatever is found."""

import numpy as np
import pytest

from nsde_torch.recording.fault import STAGES, level


def _found(p: dict[str, float], alpha: float) -> set[str]:
    found = set[str]()
    for stage in STAGES:
        found |= {stage} if p[stage] < level(stage, alpha, found) else set()
    return found


def test_shares_sum_to_alpha_where_nothing_is_found() -> None:
    assert sum(level(stage, 0.01) for stage in STAGES) == pytest.approx(0.01)


@pytest.mark.parametrize("true", [set(c) for n in range(3) for c in [STAGES[:n], STAGES[4 - n : 4]]])
def test_the_chance_of_any_false_finding_is_alpha_whatever_is_there(true: set[str]) -> None:
    alpha, rng = 0.2, np.random.default_rng(len(true))
    wrong = 0
    for _ in range(4000):
        p = {stage: 0.0 if stage in true else rng.uniform() for stage in STAGES}
        wrong += bool(_found(p, alpha) - true)
    assert wrong / 4000 < alpha + 3 * np.sqrt(alpha * (1 - alpha) / 4000)
