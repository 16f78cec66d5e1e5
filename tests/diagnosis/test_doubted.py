"""Where the guard does not believe the final physics, nothing that is found is sure, and the verdict says so."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

import nsde_torch
from nsde_torch.data import RawRun
from nsde_torch.diagnosis import decision
from nsde_torch.diagnosis.decision import doubted, sized
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.reading import Log
from nsde_torch.sysid.guard import Compared, Guarded, Objection
from nsde_torch.systems import make_system
from nsde_torch.systems.parameters import ParameterVector
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


@pytest.mark.slow
def test_an_effect_that_may_be_nothing_by_its_interval_is_a_lead(sure: Outcome) -> None:
    assert sized(sure).found == sure.found
    wide = replace(sure, of_band=np.full(len(sure.final.vector), 10.0))
    assert [f.provisional for f in sized(wide).found] == ["its size may be nothing by its interval"]


@pytest.mark.parametrize(("share", "believed"), [(-4.4, True), (-1.5, False)])
def test_a_reading_is_believed_where_it_leaves_about_as_little_as_the_laws_in_its_place(
    share: float, believed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cable on a pendulum: in degrees the declared physics leaves e^-1.5 of the rate, its law e^-4.6."""
    reading = Objection("reading", "With the angle in degrees less is left", "convert it", share=share)
    channel = Compared("theta_dot", "rad/s2", measured=10.0, fit=0.1, least_squares=0.1, first_values=9.0)
    law = Guarded(channels=(channel,))

    def guarded(regression: object, runs: object, **given: object) -> Guarded:
        return law if regression is final else Guarded(objections=(reading,))

    monkeypatch.setattr(decision, "guarded", guarded)
    system = make_system("mass_spring_damper")
    final, declared = (
        SimpleNamespace(shown=SimpleNamespace(basis=np.eye(3)), vector=ParameterVector(system))
        for _ in range(2)
    )
    outcome = SimpleNamespace(
        final=final,
        declared=declared,
        spread=SimpleNamespace(covariance=np.eye(3)),
        found=[SimpleNamespace(name="force = c1 q")],
        inputs=True,
    )
    log = SimpleNamespace(system=system, runs=(), recorded=SimpleNamespace(clock=1.0))
    found = decision.guard_of(cast(Log, log), cast(Outcome, outcome))
    assert [o.kind for o in found.objections] == ["reading"] * believed
