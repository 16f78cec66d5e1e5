"""What noise levels have learned of a law that is missing does not hide it; swings whose phase differs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.joint_selection import fitted_at
from nsde_torch.diagnosis.residual_tests import PhysicsResiduals, beyond_chance, dependences
from nsde_torch.diagnosis.search import Search
from nsde_torch.diagnosis.shape import shape
from nsde_torch.inference import LogLikelihood
from tests.diagnosis.test_shape import RUNS, described, pushed
from tests.inference.springs import rubbing, small_runs, spring


@pytest.mark.parametrize(("effect", "variable"), [("hardening", "q"), ("quadratic", "q_dot")])
def test_a_law_that_noise_levels_have_learned_is_seen_beside_them(effect: str, variable: str) -> None:
    runs = small_runs(replace(rubbing(0.0), effects={effect: {"size": 0.5}}), 4, 10.0, seed=5)
    place = fitted_at(LogLikelihood(spring(), runs, run_in=True), spring(), None)
    search = Search(spring(), runs, 1.0, Options())
    left = PhysicsResiduals(search, place, search.at(place))
    first = beyond_chance(dependences(left), {}, alpha=0.01)[0]
    assert (first.channel, first.variable, first.run) == ("q_dot", variable, None)
    assert first.p < 1e-6
    assert first.excess > 20.0


@pytest.mark.parametrize("side", ["even", "odd"])
def test_a_strong_force_is_described_as_what_it_is(side: str) -> None:
    def push(q: np.ndarray, t: np.ndarray, run: np.ndarray) -> np.ndarray:
        return -20.0 * np.maximum(q - 0.15, 0.0) if side == "even" else -4.0 * np.tanh(9.0 * q)

    words = described(push, "q")
    assert (words.variable, words.symmetry) == ("q", side)
    assert words.period is None


def test_a_swing_whose_phase_differs_from_run_to_run_is_told_with_its_frequency() -> None:
    left, seen = pushed(lambda q, t, run: 0.6 * np.sin(2 * np.pi * 4.0 * t + 2.0 * run))
    found = next(d for d in dependences(left) if d.sinusoid is not None)
    assert found.p < 1e-9
    assert 0.05 < found.share < 1.0
    assert found.excess > 20.0
    words = shape(left, found, seen, RUNS)
    assert words.period == pytest.approx(1 / 4.0, rel=0.01)
    assert "phase differs" in words.sentence
    left.inputs = False  # what was restored from an average swings by itself
    assert not any(d.sinusoid is not None for d in dependences(left))


def test_noise_does_not_swing() -> None:
    left, _ = pushed(lambda q, t, run: 0.0 * q)
    assert all(d.p > 0.01 for d in dependences(left) if d.sinusoid is not None)
