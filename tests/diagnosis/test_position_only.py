"""A log without a rate, or with one that was made of the position, is diagnosed as one with a sensor of it is."""

from types import SimpleNamespace
from typing import cast

import pytest

import nsde_torch
from nsde_torch.diagnosis.reading import Log, not_sure
from tests.helpers.diagnosed import diagnosed
from tests.helpers.encoders import encoder_runs


@pytest.mark.parametrize("rate", ["none", "backward"])
@pytest.mark.slow
def test_friction_is_named_and_what_was_inferred_is_said(rate: str) -> None:
    data = nsde_torch.read(encoder_runs(rate, runs=3, noise=5e-4), system="mass_spring_damper")
    found = nsde_torch.diagnose(data, system="mass_spring_damper").content()
    assert (found["verdict"], found["added"]) == ("effect_found", ["coulomb_friction"])
    low, high = found["parameters"]["coulomb_friction.size"]["interval_90"]
    assert 0.17 < low < high < 0.23
    (aside,) = [a for a in found["aside"] if a["effect"] == "derived_rate"]
    assert "No sensor measured q_dot" in aside["sentence"]
    assert "known from the reading" in aside["reason"]


@pytest.mark.slow
def test_nothing_is_named_of_a_count_that_holds_nothing() -> None:
    runs = encoder_runs("savgol", runs=4, friction=0.0, noise=5e-4, counts=True)
    found = nsde_torch.diagnose(runs, system="mass_spring_damper").content()
    assert (found["verdict"], found["added"]) == ("no_effect", [])


@pytest.mark.slow
def test_what_is_found_with_inferred_rates_of_several_coordinates_is_provisional() -> None:
    found, _ = diagnosed("mass_spring_damper", {"coulomb_friction": {"size": 0.5, "width": 0.01}})
    (one,) = found.outcome.found
    for rates, reason in (({"q_dot": 0.01}, ""), ({"a_dot": 0.01, "b_dot": 0.01}, "several coordinates")):
        log = cast(Log, SimpleNamespace(runs=[SimpleNamespace(inferred=rates)]))
        (again,) = not_sure(log, found.outcome).found
        assert again.name == one.name
        assert reason in again.provisional
        assert bool(reason) == bool(again.provisional)
