"""A gain at nothing in a closed loop was not measured, and what acts on inputs beside it is a lead."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nsde_torch.diagnosis.feedback_bias import beside_vanishing_gains, unmeasured_gains, vanishing_gains
from nsde_torch.diagnosis.outcome import Outcome

LABELS = ("thrust_gain", "roll_gain", "inertia_x", "motor_lag.time_constant", "linear_drag.drag[0]")


def _regression(roll_gain: float) -> Any:
    vector = SimpleNamespace(
        labels=LABELS,
        low=np.array([0.0, 0.0, 0.3, 0.0, 0.0]),
        high=np.full(5, np.inf),
        scale=np.array([4.5, 50.0, 0.7, 0.02, 0.1]),
    )
    return SimpleNamespace(vector=vector, theta=np.array([4.0, roll_gain, 0.3, 0.0, 0.0]))


@dataclass(frozen=True)
class _Found:
    name: str
    provisional: str = ""


@dataclass(frozen=True)
class _Outcome:
    final: Any
    test: Any
    found: list[_Found] = field(default_factory=list)
    provisional = Outcome.provisional


def _outcome(roll_gain: float, *, closed_loop: bool) -> Any:
    found = [_Found("motor_lag"), _Found("linear_drag"), _Found("battery_voltage", "seen already")]
    final = SimpleNamespace(regression=_regression(roll_gain))
    return _Outcome(final, SimpleNamespace(closed_loop=closed_loop), found)


def test_only_own_parameters_at_the_bound_of_nothing_count() -> None:
    assert vanishing_gains(_regression(5e-5)) == {"roll_gain"}
    assert vanishing_gains(_regression(30.0)) == set()


@pytest.mark.parametrize(("roll_gain", "closed_loop"), [(30.0, True), (5e-5, False)])
def test_gains_that_are_there_and_open_loops_change_nothing(roll_gain: float, closed_loop: bool) -> None:
    outcome = _outcome(roll_gain, closed_loop=closed_loop)
    assert beside_vanishing_gains(outcome) is outcome
    assert not unmeasured_gains(outcome)


def test_effects_on_inputs_are_leads_beside_a_gain_that_the_loop_may_hide() -> None:
    lag, drag, battery = beside_vanishing_gains(_outcome(5e-5, closed_loop=True)).found
    assert "roll_gain went to nothing" in lag.provisional
    assert not drag.provisional
    assert battery.provisional == "seen already"
