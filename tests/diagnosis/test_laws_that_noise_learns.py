"""Laws that the noise model has learned, and that no test of one variable shows: functions say what to try."""

from __future__ import annotations

from typing import Any

import pytest

from tests.helpers.diagnosed import diagnosed

SHORT: dict[str, Any] = {"durations": (8.0,) * 4, "dt": 0.02}


@pytest.mark.parametrize(("law", "size"), [("force = c1 q q_dot^2", -10.0), ("force = c1 q^2 q_dot", -10.0)])
@pytest.mark.slow
def test_a_law_of_two_variables_is_named(law: str, size: float) -> None:
    _, content = diagnosed("mass_spring_damper", {law: {"c1": size}}, **SHORT)
    assert (content["verdict"], content["added"]) == ("effect_found", [law])
    (own,) = (f for f in content["findings"] if f["name"] == law)
    assert not own["lead"]
    low, high = content["parameters"][f"{law}.c1"]["interval_90"]
    assert low - 0.5 * (high - low) <= size <= high + 0.5 * (high - low)
