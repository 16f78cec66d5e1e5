"""A gain at nothing in a closed loop was not measured."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nsde_torch.diagnosis.feedback_bias import unmeasured_gains, vanishing_gains

LABELS = ("thrust_gain", "roll_gain", "inertia_x", "motor_lag.time_constant", "linear_drag.drag[0]")


def _regression(roll_gain: float) -> Any:
    vector = SimpleNamespace(
        labels=LABELS,
        low=np.array([0.0, 0.0, 0.3, 0.0, 0.0]),
        high=np.full(5, np.inf),
        scale=np.array([4.5, 50.0, 0.7, 0.02, 0.1]),
    )
    return SimpleNamespace(vector=vector, theta=np.array([4.0, roll_gain, 0.3, 0.0, 0.0]))


def _outcome(roll_gain: float, *, closed_loop: bool) -> Any:
    return SimpleNamespace(final=_regression(roll_gain), test=SimpleNamespace(closed_loop=closed_loop))


def test_only_own_parameters_at_the_bound_of_nothing_count() -> None:
    assert vanishing_gains(_regression(5e-5)) == {"roll_gain"}
    assert vanishing_gains(_regression(30.0)) == set()


@pytest.mark.parametrize(("roll_gain", "closed_loop"), [(30.0, True), (5e-5, False)])
def test_gains_that_are_there_and_open_loops_were_measured(roll_gain: float, closed_loop: bool) -> None:
    assert not unmeasured_gains(_outcome(roll_gain, closed_loop=closed_loop))


def test_a_gain_at_nothing_may_be_hidden_by_the_loop() -> None:
    assert unmeasured_gains(_outcome(5e-5, closed_loop=True)) == {"roll_gain"}
