"""What may stand for a part of an effect, the rest of which stays, is named as a tie."""

from typing import Any

import pytest

from nsde_torch.diagnosis.decisions import Options
from tests.helpers.diagnosed import diagnosed

# the same law at all but the least speeds
NOT_TOLD_APART = ["asymmetric_friction", "coulomb_friction + constant_force"]
RIVALS = Options(candidates=("constant_wind", "linear_drag", "thrust_misalignment"))


@pytest.mark.slow
def test_air_that_moves_is_drag_and_what_else_pushes_steadily() -> None:
    wind = {"constant_wind": {"drag": [0.2, 0.2, 0.2], "wind": [1.5, 0.5]}}
    _, content = diagnosed("hexacopter", wind, options=RIVALS, durations=(8.0,) * 4)
    assert content["added"] == ["constant_wind"]
    (tie,) = content["ties"]  # all flights point the same way
    assert tie["effects"] == ["constant_wind", "linear_drag + thrust_misalignment"]
    assert "turned by a quarter" in tie["experiment"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("truth", "names"),
    [
        # fewer effects, as good: what is tied says the rest
        ([{"asymmetric_friction": {"size_forward": 0.26, "size_backward": 0.14}}], NOT_TOLD_APART[:1]),
        ([{"coulomb_friction": {"size": 0.2}}, {"constant_force": {"acceleration": 0.06}}], NOT_TOLD_APART),
    ],
    ids=["stronger one way", "plain, and a push"],
)
def test_a_friction_that_is_stronger_one_way_is_tied_with_a_plain_one_and_a_push(
    truth: list[Any], names: list[str]
) -> None:
    making: dict[str, Any] = {"durations": (8.0, 8.0), "dt": 0.02, "plant": {"force_size": 0.7}}
    _, content = diagnosed("mass_spring_damper", *truth, **making)
    added = " + ".join(content["added"])
    assert added in names
    (tie,) = content["ties"]
    assert tie["effects"][0] == added
    assert sorted(tie["effects"]) == NOT_TOLD_APART
