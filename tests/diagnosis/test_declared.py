"""Declared parameters are told with intervals; where the guard does not believe the physics, nothing is sure."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

import nsde_torch
from nsde_torch.data import RawRun, Run
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.pipeline import diagnose
from nsde_torch.diagnosis.report import page
from nsde_torch.diagnosis.text import lines
from nsde_torch.models.identified import SysidSpec
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import Diagnosed, recorded


def told(system: str, change: Callable[[Run], Run], *effects: Any, **making: Any) -> Diagnosed:
    """The diagnosis of a sound plant whose log was changed, without candidates, and its content."""
    data = recorded(system, *effects, **making)
    data = replace(data, runs=[change(run) for run in data.runs])
    declared = make_system(system)
    spec = SysidSpec(system, dt=data.dt, horizon=declared.defaults.horizon)
    found = diagnose(declared, spec, data, data.runs, Options(max_effects=0))
    return found, found.content()


@pytest.mark.slow
def test_a_force_that_was_logged_the_wrong_way_round_is_named_on_page_and_terminal() -> None:
    _, content = told("mass_spring_damper", lambda run: replace(run, u=-run.u), durations=(12.0,) * 3)
    first, second = content["warnings"]
    assert first["kind"] == "reading"
    assert "the opposite sign of 'force'" in first["sentence"]
    assert (second["kind"], second["parameter"]) == ("at_bound", "force_gain")
    assert "lower bound, 0 1/kg: freely, the data would make it about -" in second["sentence"]
    said = "\n".join(lines(content))
    assert "warning: With the opposite sign of 'force'" in said
    assert "signs, units and order of the inputs ('force')" in said
    assert "<b>Warning.</b> With the opposite sign of &#39;force&#39;" in page(content, {}, width=0.25)


@pytest.mark.parametrize("system", ["mass_spring_damper", pytest.param("cartpole", marks=pytest.mark.slow)])
def test_a_sound_log_has_no_warnings_and_its_parameters_are_told_with_intervals(system: str) -> None:
    _, content = told(system, lambda run: run, seed=4)
    assert content["warnings"] == []
    declared = content["declared_parameters"]
    assert all(p["interval_90"][0] <= p["value"] <= p["interval_90"][1] for p in declared.values())
    said = "\n".join(lines(content))
    assert "declared parameter" in said
    assert "warning" not in said
    assert all(name in said for name in declared)


@pytest.mark.slow
def test_a_machine_of_another_size_is_asked_about_only_where_the_physics_does_not_explain_it() -> None:
    def heavy(run: Run) -> Run:
        return replace(run, u=2e4 * np.asarray(run.u))

    assert told("mass_spring_damper", heavy)[1]["warnings"] == []
    rough = {"coulomb_friction": {"size": 0.1, "width": 0.01}}
    _, content = told("mass_spring_damper", heavy, rough)
    assert content["verdict"] == "unexplained"
    (odd,) = content["warnings"]
    assert (odd["kind"], odd["parameter"]) == ("far_off", "force_gain")
    assert "times below its first value 1 1/kg" in odd["sentence"]
    assert odd["remedy"].startswith("right if the machine is like that")


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
