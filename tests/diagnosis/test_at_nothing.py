"""A gain at nothing in a closed loop was not measured."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nsde_torch.diagnosis.feedback_bias import unmeasured_gains

LABELS = ("thrust_gain", "roll_gain", "inertia_x", "motor_lag.time_constant", "linear_drag.drag[0]")


def _outcome(roll_gain: float, *, closed_loop: bool) -> Any:
    vector = SimpleNamespace(
        labels=LABELS,
        low=np.array([0.0, 0.0, 0.3, 0.0, 0.0]),
        high=np.full(5, np.inf),
        scale=np.array([4.5, 50.0, 0.7, 0.02, 0.1]),
    )
    final = SimpleNamespace(vector=vector, theta=np.array([4.0, roll_gain, 0.3, 0.0, 0.0]))
    return SimpleNamespace(final=final, test=SimpleNamespace(closed_loop=closed_loop))


@pytest.mark.parametrize(
    ("roll_gain", "closed_loop", "unmeasured"),
    [(30.0, True, set()), (5e-5, False, set()), (5e-5, True, {"roll_gain"})],
)
def test_in_a_loop_only_own_parameters_at_the_bound_of_nothing_were_not_measured(
    roll_gain: float, closed_loop: bool, unmeasured: set[str]
) -> None:
    assert unmeasured_gains(_outcome(roll_gain, closed_loop=closed_loop)) == unmeasured
