"""What an identification tells of itself."""

from dataclasses import replace

import numpy as np
import pytest

import nsde_torch
from nsde_torch.sysid.guard import Guarded, Objection
from nsde_torch.sysid.identify import identify
from nsde_torch.sysid.result import Identification
from nsde_torch.systems import make_system
from nsde_torch.training.fit_sysid import summary


@pytest.fixture(scope="module")
def found() -> Identification:
    made = nsde_torch.simulate("mass_spring_damper", durations=[10.0, 10.0], seed=1)
    system = make_system("mass_spring_damper")
    return identify(system, nsde_torch.read(made, system=system).runs)


def test_no_interval_is_given_for_a_fit_that_had_not_settled(found: Identification) -> None:
    assert np.isfinite(found.half_widths(0.9)).all()
    unsettled = replace(found, converged=False)
    assert np.isnan(unsettled.half_widths(0.9)).all()
    assert all(p["half_width_90"] == [None] * len(p["value"]) for p in unsettled.parameters().values())  # type: ignore[arg-type]
    notes = [{p.get("note") for p in one.parameters().values()} for one in (unsettled, found)]
    assert notes == [{"no interval: the fit had not settled"}, {None}]
    assert any("no interval is given" in line for line in unsettled.findings)
    assert "had not settled" in summary(unsettled)


def test_no_interval_is_given_for_a_fit_that_the_guard_speaks_against(found: Identification) -> None:
    assert not found.warnings
    told = replace(
        found, guard=Guarded((Objection("worse", "it leaves more than was measured", "look at it"),))
    )
    assert np.isnan(told.half_widths(0.9)).all()
    assert told.warnings[0] == "it leaves more than was measured; look at it"
    assert "no interval is given" in summary(told)
    assert "rejected" in summary(told)
