"""What no effect of the catalogue explains is called unexplained, or a lead, with its shape."""

from pathlib import Path

import numpy as np
import pytest

from nsde_torch.diagnosis.decisions import Budgets, Options
from tests.helpers.diagnosed import assert_interval, diagnosed

FOLDER = Path(__file__).parents[2] / "benchmarks" / "blind"
needs_outside = pytest.mark.skipif(not FOLDER.is_dir(), reason="the benchmarks are not part of a wheel")


@pytest.fixture
def _outside(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(FOLDER)


@needs_outside
@pytest.mark.usefixtures("_outside")
@pytest.mark.slow
def test_a_magnet_on_the_pole_is_a_ripple_of_the_catalogue_and_unexplained_without_it() -> None:
    magnet = {"outside:PoleMagnet": {"size": 1.5}}
    _, content = diagnosed("cartpole", magnet, durations=(4.0,) * 16)
    assert content["added"] == ["ripple[pole]"]
    found = content["parameters"]
    assert found["ripple[pole].order"]["value"] == pytest.approx(2.0, abs=0.02)
    assert_interval(found, "ripple[pole].sine", -1.5)
    few = Options(candidates=("coulomb_friction[pole]", "quadratic_damping[pole]"))
    _, content = diagnosed("cartpole", magnet, options=few, durations=(4.0,) * 16)
    assert content["verdict"] == "unexplained"
    assert "no effect of the catalogue" in content["summary"]
    first = next(s for s in content["unexplained"] if s["variable"] == "theta")
    assert first["channel"] == "theta_dot"
    assert first["period"] == pytest.approx(np.pi, rel=0.1)
    assert "periodically" in first["sentence"]


@needs_outside
@pytest.mark.usefixtures("_outside")
@pytest.mark.slow
def test_a_spring_that_hardens_faster_than_the_catalogue_knows_is_a_law_with_its_power() -> None:
    case = ("mass_spring_damper", {"outside:QuinticStiffness": {"size": 8.0}})
    _, content = diagnosed(*case, durations=(10.0,) * 6)
    law = "force = c1 q^5"
    assert (content["verdict"], content["added"]) == ("effect_found", [law])
    assert content["parameters"][f"{law}.c1"]["value"] == pytest.approx(-8.0, rel=0.15)
    _, content = diagnosed(*case, durations=(10.0,) * 6, budgets=Budgets(laws=0))
    assert content["verdict"] == "unexplained" or all(f["lead"] for f in content["findings"])
    assert content["added"] in ([], ["cubic_stiffness"])
    first = content["unexplained"][0]
    assert (first["channel"], first["variable"], first["symmetry"]) == ("q_dot", "q", "odd")
