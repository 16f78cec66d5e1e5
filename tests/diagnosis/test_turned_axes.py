"""A flight controller that is mounted askew is named, and its angles are found."""

import numpy as np
import pytest

from nsde_torch.diagnosis.decisions import Options
from nsde_torch.recording import Recording
from tests.helpers.diagnosed import diagnosed

TURN_DEG = [2.0, -1.0, 15.0]
THERE = {"frame_misalignment", "motor_lag"}
RIVALS = Options(candidates=(*sorted(THERE), "thrust_misalignment", "inertia_coupling"))


@pytest.mark.slow
def test_axes_of_the_log_that_are_turned_are_named_and_not_a_tilted_thrust_or_skew_masses() -> None:
    turned = Recording(frame_misalignment=TURN_DEG)
    _, content = diagnosed("hexacopter", options=RIVALS, durations=(10.0,) * 4, recording=turned)
    assert set(content["added"]) == THERE
    for axis, angle in enumerate(np.radians(TURN_DEG)):
        found = content["parameters"][f"frame_misalignment.turn[{axis}]"]
        low, high = found["interval_90"]
        assert abs(found["value"] - angle) < high - low < (0.2 if axis == 2 else 0.03)
        assert found["unit"] == "rad"
