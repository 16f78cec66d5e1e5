"""What is set from the data before the first gradient step."""

import numpy as np
import pytest
import torch

from nsde_torch.data import Run, Windows
from nsde_torch.models import NeuralSDE, SDESpec
from nsde_torch.simulation import simulated
from nsde_torch.training.prepare import prepare, sensor_std
from tests.helpers.toy_systems import DT, Decay, decay_runs, make_model


def prepared(horizon: int = 10, **spec: object) -> tuple[NeuralSDE, list[Run]]:
    model = make_model(Decay, horizon=horizon, **spec).requires_grad_(False)
    model.h.log_sigma_max.requires_grad_("sigma_max" not in spec)
    runs = decay_runs(2, 60.0, sigma=0.5)
    prepare(model, runs, Windows(runs, DT, horizon), clock_scale=1.04, given=())
    return model, runs


def test_features_are_standardised_to_the_training_data_and_the_clock_is_theirs() -> None:
    model, runs = prepared()
    assert float(model.clock_scale) == pytest.approx(1.04)
    x = np.concatenate([run.x for run in runs])
    assert float(model.eta.standardise.mean) == pytest.approx(x.mean(), abs=0.02)
    assert float(model.eta.standardise.scale) == pytest.approx(x.std(), rel=0.05)
    assert float(model.residual_inputs.scale) == pytest.approx(x.std(), rel=0.05)


def test_first_largest_sigma_is_four_times_the_roughness_of_the_data() -> None:
    model, _ = prepared()
    # second differences of a random walk have twice the variance of a step
    assert float(model.h.log_sigma_max.detach().exp()) == pytest.approx(4 * 0.5 * 0.5 * 2**0.5, rel=0.1)


@pytest.mark.parametrize("horizon", [1, 2])
def test_the_shortest_horizons_have_a_finite_first_sigma(horizon: int) -> None:
    model, _ = prepared(horizon)
    assert bool(torch.isfinite(model.h.log_sigma_max).all())
    assert float(model.h.log_sigma_max.detach().exp()) > 1e-3


def test_sensor_noise_of_smooth_motion_is_found_from_its_roughness() -> None:
    t = 0.01 * np.arange(4000)
    rng = np.random.default_rng(0)
    smooth = np.stack((np.sin(2 * t), 2 * np.cos(2 * t)), 1)
    noise = np.array([0.003, 0.02])
    run = Run("swing", t, smooth + noise * rng.standard_normal(smooth.shape), np.zeros((4000, 1)))
    np.testing.assert_allclose(sensor_std([run]), noise, rtol=0.06)
    clean = Run("clean", t, smooth, np.zeros((4000, 1)))
    assert float(sensor_std([clean]).max()) < 1e-6


@pytest.mark.slow
def test_first_parameters_of_a_multirotor_come_near_those_of_the_plant() -> None:
    data = simulated("hexacopter", durations=[10.0], process_noise=0.1, sensor_noise=0.1)
    spec = SDESpec("hexacopter", dt=0.05, horizon=20, step="milstein")
    model = NeuralSDE(spec, generator=torch.Generator().manual_seed(0))
    defaults = {k: v.clone() for k, (v, _) in model.system.all_declared().items()}
    runs = list(data.runs)
    prepare(model, runs, Windows(runs, 0.05, 20), clock_scale=data.clock_scale, given=())
    values = {k: v for k, (v, _) in model.system.all_declared().items()}
    for name in ("thrust_gain", "roll_gain", "pitch_gain", "yaw_gain"):
        assert float(values[name]) > 0
        assert float(values[name]) != float(defaults[name])
    hover = float(values["thrust_gain"]) * float(runs[0].u.sum(1).mean()) + float(values["thrust_offset"])
    assert hover == pytest.approx(9.81, rel=0.05)


def test_declared_parameters_that_the_user_gave_keep_their_values() -> None:
    spec = SDESpec("hexacopter", dt=0.05, horizon=20, step="milstein")
    model = NeuralSDE(spec, generator=torch.Generator().manual_seed(0), values={"roll_gain": 33.0})
    rng = np.random.default_rng(0)
    x = model.project(torch.from_numpy(rng.standard_normal((200, 13))).float()).detach().numpy()
    runs = [Run("shaken", 0.05 * np.arange(200), x, rng.uniform(size=(200, 6)))]
    prepare(model, runs, Windows(runs, 0.05, 20), clock_scale=1.0, given=["roll_gain"])
    assert float(model.system.value("roll_gain").detach()) == pytest.approx(33.0)
