"""Where the guard does not believe the final physics, nothing that is found is sure, and the verdict says so."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

import nsde_torch
from nsde_torch.data import RawRun
from nsde_torch.diagnosis.decision import doubted, sized
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.sysid.guard import Guarded, Objection
from tests.helpers.diagnosed import diagnosed


@pytest.mark.slow
def test_what_is_found_behind_a_smoother_that_is_kept_is_no_more_than_a_lead() -> None:
    runs = []
    for run in nsde_torch.simulate("cartpole", durations=[10.0] * 3, seed=3, declared_only=True).runs:
        x = np.asarray(sosfiltfilt(butter(2, 2.0, fs=50.0, output="sos"), run.x, axis=0))
        runs.append(RawRun(run.name, run.t, x, run.u))
    data = nsde_torch.read(runs, system="cartpole", state_smoothing="keep")
    found = nsde_torch.diagnose(data, system="cartpole", candidates=["actuator_lag", "input_delay"])
    content = found.content()
    assert content["guard"]["objections"]
    assert content["verdict"] == "unexplained"
    assert "rejected" in content["summary"]
    assert all(finding["lead"] for finding in content["findings"])
    assert all(p["interval_90"] is None for p in content["parameters"].values())
    assert "rejected" in found.report


@pytest.fixture(scope="module")
def sure() -> Outcome:
    """Dry friction that is found for sure."""
    only = Options(candidates=("coulomb_friction",))
    outcome = diagnosed("mass_spring_damper", "coulomb_friction", options=only)[0].outcome
    assert [(f.name, f.provisional) for f in outcome.found] == [("coulomb_friction", "")]
    return outcome


@pytest.mark.slow
def test_where_physics_explains_next_to_nothing_what_is_found_is_a_lead_and_the_verdict_stays(
    sure: Outcome,
) -> None:
    poor = doubted(sure, Guarded((Objection("poor", "it explains next to nothing", "move it"),)))
    assert [f.name for f in poor.found if f.provisional] == ["coulomb_friction"]
    assert poor.verdict == sure.verdict == "effect_found"
    assert not poor.doubted
    assert doubted(sure, Guarded()) is sure


@pytest.mark.slow
def test_an_objection_to_channels_speaks_of_what_moves_them(sure: Outcome) -> None:
    there, elsewhere = (
        doubted(sure, Guarded((Objection("gone", "it explains nothing", "look", (name,)),)))
        for name in ("q_dot", "w_x")
    )
    assert there.doubted
    assert there.verdict == "unexplained"
    assert all(f.provisional for f in there.found)
    assert not elsewhere.doubted
    assert elsewhere.verdict == sure.verdict
    assert elsewhere.found == sure.found
    assert elsewhere.doubted_channels == {"w_x"}


def test_an_effect_that_may_be_nothing_by_its_interval_is_a_lead(sure: Outcome) -> None:
    assert sized(sure).found == sure.found
    wide = replace(sure, of_band=np.full(len(sure.final.vector), 10.0))
    assert [f.provisional for f in sized(wide).found] == ["its size may be nothing by its interval"]
