"""A law of the noise that has learned what the physics lacks does not hide it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nsde_torch.diagnosis.residual_tests import NoiseModels, dependences
from nsde_torch.diagnosis.shape import rates, shape
from tests.diagnosis.test_shape import RUNS, Push, pushed

STRONG: list[tuple[str, Push, str]] = [
    ("a stop that is hit now and then", lambda q, t, run: -20.0 * np.maximum(q - 0.15, 0.0), "even"),
    ("a strong smooth force", lambda q, t, run: -4.0 * np.tanh(9.0 * q), "odd"),
]


@pytest.mark.parametrize(
    ("push", "side"), [(p, s) for _, p, s in STRONG], ids=[name for name, _, _ in STRONG]
)
def test_a_strong_force_is_seen_through_the_law_of_the_noise_that_it_leaves(push: Push, side: str) -> None:
    r, variables = pushed(push)
    laws = NoiseModels(r, 0, float(r.carry_limits()[r.rows[0]]))
    other = laws.without(variables.functions["q"]()[0])
    assert other is not None
    assert other.likelihood > laws.base.likelihood + 100
    assert other.noise.std < laws.base.noise.std
    most = max(dependences(r, variables), key=lambda d: d.excess)
    assert (most.channel, most.variable) == ("q_dot", "q")
    assert most.noise is not None
    assert most.noise.std == other.noise.std
    assert most.p < 1e-12
    words = shape(r, most, variables, rates(r, variables), RUNS)
    assert (words.variable, words.symmetry) == ("q", side)
    assert words.period is None


def test_functions_that_nothing_depends_on_leave_the_law_as_it_is() -> None:
    r, variables = pushed(lambda q, t, run: 0.0 * q)
    laws = NoiseModels(r, 0, float(r.carry_limits()[r.rows[0]]))
    assert [laws.without(f()[0]) for f in variables.functions.values()] == [None] * len(variables.functions)
    assert min(d.p for d in dependences(r, variables)) > 1e-4


def test_another_law_of_one_channel_leaves_theta_and_the_regression_as_they_are() -> None:
    r, _ = pushed(lambda q, t, run: 4.0 * np.sin(9.0 * q))
    law = r.own_noises(0)[0]
    before = r.white.copy()
    there = r.under(0, law)
    np.testing.assert_array_equal(r.white, before)
    np.testing.assert_array_equal(there.theta, r.theta)
    np.testing.assert_allclose(there.white[0], r.whitened(law, r.residual[:, r.rows])[:, 0])
    assert there.noises[0] is law


def test_a_swing_whose_phase_differs_from_run_to_run_is_told_with_its_frequency() -> None:
    r, variables = pushed(lambda q, t, run: 0.6 * np.sin(2 * np.pi * 4.0 * t + 2.0 * run))
    found = next(d for d in dependences(r, variables) if d.sinusoid is not None)
    assert found.p < 1e-9
    assert 0.05 < found.share < 1.0
    words = shape(r, found, variables, rates(r, variables), RUNS)
    assert words.period == pytest.approx(1 / 4.0, rel=0.01)
    assert "phase differs" in words.sentence
    # what was restored from an average swings by itself
    restored = dependences(r, replace(variables, inputs=False))
    assert not any(d.sinusoid is not None for d in restored)


def test_noise_does_not_swing() -> None:
    r, variables = pushed(lambda q, t, run: 0.0 * q)
    assert all(d.p > 0.01 for d in dependences(r, variables) if d.sinusoid is not None)
