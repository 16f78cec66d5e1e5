"""Significance levels: one alpha for all stages, whatever is found."""

from itertools import product

import numpy as np
import pytest

from nsde_torch.recording.fault import STAGES, level
from nsde_torch.recording.faults import FAULTS


def _found(p: dict[str, float], alpha: float) -> set[str]:
    found = set[str]()
    for stage in STAGES:
        found |= {stage} if p[stage] < level(stage, alpha, found) else set()
    return found


def test_shares_sum_to_alpha_where_nothing_is_found() -> None:
    assert sum(level(stage, 0.01) for stage in STAGES) == pytest.approx(0.01)


def test_what_is_found_hands_its_level_on_until_a_stage_finds_nothing() -> None:
    assert level("effects", 0.01, {"biases"}) == pytest.approx(0.004)
    assert level("effects", 0.01, {"clock", "lateness", "biases"}) == pytest.approx(0.008)
    assert level("effects", 0.01, {"clock", "lateness"}) == pytest.approx(0.002)


@pytest.mark.parametrize("true", [set(c) for n in range(3) for c in [STAGES[:n], STAGES[4 - n : 4]]])
def test_the_chance_of_any_false_finding_is_alpha_whatever_is_there(true: set[str]) -> None:
    alpha, rng = 0.2, np.random.default_rng(len(true))
    wrong = 0
    for _ in range(4000):
        p = {stage: 0.0 if stage in true else rng.uniform() for stage in STAGES}
        wrong += bool(_found(p, alpha) - true)
    assert wrong / 4000 < alpha + 3 * np.sqrt(alpha * (1 - alpha) / 4000)


def test_all_that_bonferroni_finds_is_found() -> None:
    alpha = 0.05
    for p in product((0.005, 0.015, 0.5), repeat=len(STAGES)):
        by_stage = dict(zip(STAGES, p, strict=True))
        assert {s for s, v in by_stage.items() if v < alpha / len(STAGES)} <= _found(by_stage, alpha)


def test_faults_are_tested_at_stages_that_there_are() -> None:
    assert {fault.stage for fault in FAULTS.values()} - {""} == set(STAGES[:3])
