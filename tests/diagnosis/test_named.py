"""A diagnosis names the effect that a plant has and the model was not told of, and nothing where nothing is missing."""

from typing import Any

import numpy as np
import pytest
from remembering import DT, RIGHT, run

import nsde_torch
from nsde_torch.data.raw import RawRun
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.recording import Recording
from tests.helpers.diagnosed import diagnosed

FRICTION = {"coulomb_friction": {"size": 0.3}}
ALONE: list[tuple[str, str, dict[str, Any]]] = [
    ("mass_spring_damper", "coulomb_friction", {"size": 0.3}),
    ("mass_spring_damper", "asymmetric_friction", {"size_forward": 0.5, "size_backward": 0.1}),
    ("mass_spring_damper", "quadratic_damping", {"damping": 0.6}),
    ("mass_spring_damper", "cubic_stiffness", {"stiffness": 4.0}),
    ("mass_spring_damper", "constant_force", {"acceleration": 0.2}),
    ("mass_spring_damper", "input_delay", {"delay": 0.05}),
    ("mass_spring_damper", "actuator_lag", {"time_constant": 0.08}),
    ("mass_spring_damper", "actuator_deadband", {"width": 0.3}),
    ("mass_spring_damper", "asymmetric_deadband", {"width_forward": 0.5, "width_backward": 0.2}),
    ("mass_spring_damper", "asymmetric_gain", {"asymmetry": 0.1}),
    ("mass_spring_damper", "actuator_saturation", {"level": 0.6}),
    ("mass_spring_damper", "actuator_gain_drift", {"rate": 0.05}),
    ("cartpole", "coulomb_friction[cart]", {"size": 0.4}),
    ("cartpole", "viscous_friction[cart]", {"damping": 0.3}),
    ("cartpole", "viscous_friction[pole]", {"damping": 0.3}),
    ("cartpole", "coulomb_friction[pole]", {"size": 0.5}),
    ("cartpole", "track_tilt", {"slope": 0.03}),
    ("cartpole", "gravity", {"excess": 0.5}),
]


@pytest.mark.parametrize(("system", "name", "values"), ALONE, ids=[name for _, name, _ in ALONE])
@pytest.mark.slow
def test_an_effect_alone_is_named_first_and_its_size_lies_near_the_interval(
    system: str, name: str, values: dict[str, float]
) -> None:
    _, content = diagnosed(system, {name: values})
    assert (content["verdict"], content["added"][0]) == ("effect_found", name)
    assert any(r["chosen"] and r["effect"] == name for r in content["ranking"])
    key, value = next(iter(values.items()))
    parameter = content["parameters"][f"{name}.{key}"]
    low, high = parameter["interval_90"]
    assert abs(parameter["value"] - value) < 2 * (high - low) + 0.02 * abs(value)
    assert content["findings"][0]["p"] < 0.01


@pytest.mark.parametrize(
    ("system", "seed"),
    [
        ("mass_spring_damper", 1),
        pytest.param("mass_spring_damper", 2, marks=pytest.mark.slow),
        pytest.param("cartpole", 3, marks=pytest.mark.slow),
    ],
)
def test_nothing_is_found_where_nothing_is_missing(system: str, seed: int) -> None:
    _, content = diagnosed(system, seed=seed)
    assert (content["verdict"], content["added"], content["parameters"]) == ("no_effect", [], {})
    assert content["errors"]["before"] == content["errors"]["after"]


@pytest.mark.slow
def test_two_effects_at_once_are_both_found() -> None:
    _, content = diagnosed("mass_spring_damper", FRICTION, {"input_delay": {"delay": 0.05}})
    assert set(content["added"]) == {"coulomb_friction", "input_delay"}
    assert content["parameters"]["coulomb_friction.size"]["value"] == pytest.approx(0.3, rel=0.1)
    assert content["parameters"]["input_delay.delay"]["value"] == pytest.approx(0.05, abs=0.01)
    later = [r for r in content["ranking"] if r["round"] == 1]
    assert any(r["chosen"] for r in later)


@pytest.mark.slow
def test_effects_that_the_data_cannot_tell_apart_are_a_tie_with_an_experiment() -> None:
    _, content = diagnosed("mass_spring_damper", {"constant_force": {"acceleration": 0.2}})
    (tie,) = content["ties"]
    assert tie["effects"] == ["constant_force", "sensor_bias"]
    assert tie["experiment"]
    # too little time to see how an input is late
    _, content = diagnosed(
        "mass_spring_damper", {"input_delay": {"delay": 0.03}}, durations=(4.0,) * 3, sensor_noise=3.0
    )
    assert content["added"] in (["input_delay"], ["actuator_lag"])
    (tie,) = content["ties"]
    assert {"input_delay", "actuator_lag"} <= set(tie["effects"])
    assert tie["effects"][0] == content["added"][0]
    assert tie["experiment"]


@pytest.mark.slow
def test_rows_that_are_missing_do_not_hide_an_effect() -> None:
    _, content = diagnosed("mass_spring_damper", FRICTION, recording=Recording(dropout=0.1))
    assert content["added"] == ["coulomb_friction"]
    assert any("gaps in time" in line for line in content["data"]["done"])


@pytest.mark.slow
def test_one_run_alone_is_diagnosed_and_its_last_part_is_what_errors_are_measured_on() -> None:
    _, content = diagnosed("mass_spring_damper", FRICTION, durations=(20.0,))
    assert content["added"] == ["coulomb_friction"]
    assert content["errors"]["measured_on"] == "the last part of the only run"
    assert content["errors"]["ratio"]["velocity"]["0.5"] < 0.9


@pytest.mark.slow
def test_only_the_candidates_that_are_named_are_tried() -> None:
    options = Options(candidates=("quadratic_damping", "cubic_stiffness"))
    _, content = diagnosed("mass_spring_damper", FRICTION, options=options)
    assert {r["effect"] for r in content["ranking"]} <= {"quadratic_damping", "cubic_stiffness"}


@pytest.mark.slow
def test_runs_without_an_input_cannot_show_what_the_input_does() -> None:
    _, content = diagnosed("mass_spring_damper", {"input_delay": {"delay": 0.05}}, plant={"force": "zero"})
    assert content["verdict"] == "no_effect"
    unseen = {n["effect"]: n for n in content["not_shown"]}
    assert {"input_delay", "actuator_lag", "actuator_deadband", "actuator_gain_drift"} <= set(unseen)
    assert unseen["input_delay"]["smallest"] is None
    assert unseen["input_delay"]["experiment"]
    assert "could not show" in content["summary"]


@pytest.mark.slow
def test_a_machine_at_rest_shows_nothing_and_the_diagnosis_says_so() -> None:
    at_rest = {"force": "zero", "region": ((0.0, 1e-9), (0.0, 1e-9))}
    _, content = diagnosed("mass_spring_damper", plant=at_rest, durations=(6.0,) * 3)
    assert content["verdict"] == "no_effect"
    assert "could not show" in content["summary"]
    never = {n["effect"] for n in content["not_shown"] if n["smallest"] is None}
    assert {"input_delay", "cubic_stiffness", "quadratic_damping"} <= never


@pytest.mark.parametrize(
    "beside", [{}, {"coulomb_friction[cart]": {"size": 0.4}}], ids=["alone", "beside friction"]
)
@pytest.mark.slow
def test_inputs_that_act_a_fraction_of_a_step_late_are_taken_into_account_and_not_named(
    beside: dict[str, Any],
) -> None:
    late = {"input_delay": {"delay": 0.003}}
    _, content = diagnosed("cartpole", late, *([beside] if beside else []), sensor_noise=0.3)
    assert content["added"] == list(beside)
    assert [a["effect"] for a in content["aside"]] == ["input_delay"]
    assert "0.003" in content["aside"][0]["sentence"] or "0.0029" in content["aside"][0]["sentence"]
    # predictions step over a memory that is faster than they are
    errors = content["errors"]["after"]["position"]
    assert all(v is not None and v < 1.0 for v in errors.values())


@pytest.mark.parametrize(
    ("kind", "own", "true"),
    [
        ("bouc_wen", "reach", 0.08),
        ("play", "gap", 0.25),
        ("delay", "delay", 0.04),
        ("coulomb", "size", 0.4),
        ("maxwell", "stiffness", 2.4),
        ("fluid", "exchange", 1.6),
    ],
)
@pytest.mark.slow
def test_it_is_named_for_what_it_is(kind: str, own: str, true: float) -> None:
    late = 0.25 if kind == "play" else 0.04
    values = {"k": 3.0, "b": 0.4, "g": 1.1, "size": 0.4, "reach": 0.08, "slow": 0.5, "time": late}
    runs = []
    for n in range(3):
        x, u = run(kind, values, np.random.default_rng([9, n]))
        runs.append(RawRun(f"run_{n}", DT * np.arange(len(x)) + 100.0 * n, x, u))
    found = nsde_torch.diagnose(runs, system="mass_spring_damper").content()
    assert found["added"] == [RIGHT[kind]]
    assert found["parameters"][f"{RIGHT[kind]}.{own}"]["value"] == pytest.approx(true, rel=0.1)
