"""Faults of the recording chain are found by kinematics and spectra alone, before physics is looked at."""

import numpy as np
import pytest

import nsde_torch
from nsde_torch.data import Run
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.recording import Recording
from nsde_torch.recording.smoothing import restored
from tests.helpers.diagnosed import assert_interval, diagnosed
from tests.helpers.encoders import encoder_runs

ALONE = Options(max_effects=0)  # the recording chain is looked at before any effect


@pytest.mark.parametrize(
    ("system", "name"),
    [("mass_spring_damper", "q_dot"), pytest.param("cartpole", "theta", marks=pytest.mark.slow)],
)
def test_a_sensor_that_comes_late_is_found_and_not_taken_for_an_effect(system: str, name: str) -> None:
    _, content = diagnosed(system, recording=Recording(sensor_delay={name: 0.05}), durations=(10.0,) * 4)
    assert content["added"] == ["sensor_delay"]
    late = content["parameters"][f"sensor_delay.{name}"]
    assert late["interval_90"][0] < 0.05 < late["interval_90"][1]
    assert f"{name} is logged" in content["findings"][0]["sentence"]


@pytest.mark.slow
def test_friction_has_its_size_in_its_interval_behind_a_filter_whose_noise_came_after_it() -> None:
    chain = Recording(sensor_lag={"q_dot": 0.05})
    _, content = diagnosed("mass_spring_damper", {"coulomb_friction": {"size": 0.15}}, recording=chain)
    assert_interval(content["parameters"], "coulomb_friction.size", 0.15, width=0.03)


@pytest.mark.slow
def test_a_camera_whose_angle_and_rate_are_late_alike_is_found() -> None:
    chain = Recording(sensor_delay={"theta": 0.04, "theta_dot": 0.04})
    _, content = diagnosed("cartpole", recording=chain, durations=(4.0,) * 4)
    assert content["added"] == ["sensor_delay"]
    for channel in ("theta", "theta_dot"):
        assert_interval(content["parameters"], f"sensor_delay.{channel}", 0.04, slack=0.002)
    assert content["unexplained"] == []


@pytest.mark.slow
def test_inputs_that_were_averaged_are_found_and_restored() -> None:
    there, averaged = diagnosed(
        "cartpole", options=ALONE, durations=(12.0,) * 4, recording=Recording(input_smoothing=0.2)
    )
    assert averaged["added"] == ["input_smoothing"]
    assert averaged["parameters"]["input_smoothing.width"]["value"] == pytest.approx(0.2)
    here, raw = diagnosed("cartpole", options=ALONE, durations=(12.0,) * 4)
    assert raw["added"] == []
    # what was restored errs, and a residual depends on the errors of an input
    assert "force" not in there.outcome.variables.columns
    assert "force" in here.outcome.variables.columns


def test_restored_inputs_are_nearer_to_those_that_acted_than_their_average() -> None:
    rng = np.random.default_rng(0)
    u = np.cumsum(rng.normal(size=(600, 2)), 0)  # a command that wanders
    weights = np.ones(11) / 10
    weights[[0, -1]] *= 0.5
    average = np.stack([np.convolve(column, weights, "same") for column in u.T], 1)
    run = Run("run", t=np.arange(600) * 0.02, x=np.zeros((600, 1)), u=average)
    inner = slice(20, -20)
    left = np.square(restored(run, 2, 0.2).u - u)[inner].mean()
    assert left < 0.2 * np.square(average - u)[inner].mean()


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
def test_a_clock_that_runs_wrong_is_found() -> None:
    _, content = diagnosed(
        "cartpole", options=ALONE, recording=Recording(clock_scale=1.08), durations=(4.0,) * 12
    )
    assert content["added"] == ["clock_scale"]
    assert_interval(content["parameters"], "clock_scale.scale", 1.08)
    assert content["data"]["clock_scale"] == content["parameters"]["clock_scale.scale"]["value"]
    assert "x and theta move further than their rates say" in content["findings"][0]["sentence"]
    assert content["ties"] == []
