"""Behind a smoother in a closed loop: no effects with memory on inputs, and nothing that is sure."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.feedback_bias import behind_smoothers, not_sure_behind_smoothers, with_suspects
from nsde_torch.diagnosis.joint_selection import JointSearch
from nsde_torch.diagnosis.search import Search
from nsde_torch.inference import LogLikelihood
from nsde_torch.systems import make_system
from tests.inference.springs import linear_runs


def test_effects_with_memory_on_inputs_are_no_candidates() -> None:
    system = make_system("mass_spring_damper")
    search = Search(system, linear_runs(1, 4.0), 1.0, Options())
    names = behind_smoothers(search, system).candidates
    assert names is not None
    assert not {"input_delay", "actuator_lag"} & set(names)
    assert {"actuator_deadband", "coulomb_friction", "hysteresis"} <= set(names)
    assert search.candidates is None


def test_what_was_found_is_a_lead_where_what_was_no_candidate_would_explain_more() -> None:
    joint = SimpleNamespace(suspected=())
    outcome: Any = SimpleNamespace(joint=joint, provisional=lambda why: why(None))
    assert not_sure_behind_smoothers(outcome) is outcome
    joint.suspected = ("input_delay",)
    assert "input_delay" in cast(Any, not_sure_behind_smoothers(outcome))


def test_a_lag_is_suspected_beside_what_was_found_without_it() -> None:
    system = make_system("mass_spring_damper")
    runs = linear_runs(3, 8.0, seed=1, lag=0.08)
    search = Search(system, runs, 1.0, Options())
    some = behind_smoothers(search, system)
    found = JointSearch(some, LogLikelihood(system, runs, run_in=True), system).selected()
    assert not {"input_delay", "actuator_lag"} & set(found.selected)
    assert with_suspects(replace(found, selected={}), search, system).suspected == ()
    found = replace(found, selected={"coulomb_friction": cast(Any, None)})
    assert set(with_suspects(found, search, system).suspected) & {"input_delay", "actuator_lag"}
