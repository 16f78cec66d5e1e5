"""Inputs of an open loop: as fine about rest as a dry friction needs, within the range, and smaller on request."""

import numpy as np
import pytest

from nsde_torch.design.limits import ExperimentLimits
from nsde_torch.design.proposals import Signals


@pytest.fixture
def signals() -> Signals:
    """A force from -10 to 30 N: rest is not in the middle."""
    none = np.array([-np.inf]), np.array([np.inf])
    limits = ExperimentLimits(("force",), np.array([-10.0]), np.array([30.0]), ("x",), *none)
    return Signals(limits, 0.02, 200, (0.2, 5.0))


def test_proposals_are_of_all_sizes_about_rest_and_stay_within_the_range(signals: Signals) -> None:
    u = signals.inputs(signals.random(400, np.random.default_rng(0)))
    assert u.shape == (400, 200, 1)
    assert u.min() >= -10.0
    assert u.max() <= 30.0
    largest = np.abs(u).max((1, 2))
    for low, high in ((0.0, 1.0), (1.0, 5.0), (5.0, 30.1)):
        assert ((largest >= low) & (largest < high)).mean() > 0.1


def test_gentle_inputs_are_nearly_nothing(signals: Signals) -> None:
    u = signals.inputs(signals.gentle(8, np.random.default_rng(0)))
    assert np.abs(u[0]).max() < 0.2
    assert np.abs(u).max() < 4.0


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_a_smaller_experiment_is_the_same_wave_in_proportion(signals: Signals, share: float) -> None:
    genes = signals.gentle(8, np.random.default_rng(1))  # not clipped at the ends of the range
    smaller = signals.shrunk(genes, np.full(8, share))
    np.testing.assert_allclose(signals.inputs(smaller), share * signals.inputs(genes), atol=1e-9)
