"""A machine that sticks has dry friction, and nothing beside it that tells how friction holds."""

import pytest

import nsde_torch
from tests.helpers.sticking import STICKING, sticking_runs


@pytest.mark.parametrize("size", [1.0, 2.4])  # it stands in a quarter of the rows, and in three quarters
@pytest.mark.slow
def test_dry_friction_that_holds_is_named_alone_and_all_values_are_right(size: float) -> None:
    found = nsde_torch.diagnose(
        sticking_runs(size, seconds=20.0),
        system="mass_spring_damper",
        candidates=["coulomb_friction", "stribeck_friction", "actuator_deadband", "quadratic_damping"],
    )
    assert found.added == ["coulomb_friction"]
    content = found.content()
    for name, truth in {**STICKING, "coulomb_friction.size": size}.items():
        entry = {**found.parameters, **content["declared_parameters"]}[name]
        low, high = entry["interval_90"]
        assert abs(entry["value"] - truth) < max(1.5 * (high - low) / 2.0, 0.005 * truth)
    share = content["data"]["standing_share"]
    assert 0.1 < share < 0.85
    assert f"{share:.0%} of the rows were left out" in found.report
