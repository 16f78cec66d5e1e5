"""A whole training through Python: what odd sets of runs do to it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nsde_torch.data import RawRun, Run, Windows, split
from nsde_torch.errors import DataError
from nsde_torch.models import NeuralSDE, SDESpec
from nsde_torch.recording import assemble
from nsde_torch.systems import make_system
from nsde_torch.training import LossOptions, TrainerOptions, Training
from nsde_torch.training.prepare import prepare, sensor_std
from tests.helpers.toy_systems import DT, Decay, decay_runs, make_model

OPTIONS = TrainerOptions(steps=2, batch=8, polish=1, compile="off")


def swing(name: str, seconds: float, seed: int) -> RawRun:
    t = 0.02 * np.arange(round(seconds / 0.02) + 1)
    x = np.stack((0.1 * np.sin(t + seed), 0.1 * np.cos(t + seed)), 1)
    x += 0.002 * np.random.default_rng(seed).standard_normal(x.shape)
    return RawRun(name, t, x, np.zeros((len(t), 1)))


def run(
    seconds: list[float], folder: Path, *, test: list[int] | None, horizon: int = 10, verbose: bool = False
) -> tuple[dict[str, Any], str]:
    raw = [swing(f"swing_{k}", s, k) for k, s in enumerate(seconds)]
    data = assemble(raw, make_system("mass_spring_damper"), kind="csv")
    said: list[str] = []
    spec = SDESpec("mass_spring_damper", dt=0.02, horizon=horizon, step="euler_maruyama")
    how: dict[str, Any] = {"loss": LossOptions(points=8), "options": OPTIONS, "seed": 0, "verbose": verbose}
    parts = split(data, test)
    metrics = Training(spec=spec, data=data, split=parts, run_dir=folder, say=said.append, **how).run()
    return metrics, "\n".join(said)


@pytest.mark.slow
def test_a_training_run_too_short_to_test_on_is_not_left_out_and_that_is_said(tmp_path: Path) -> None:
    metrics, said = run([8.0, 6.0, 0.08], tmp_path, test=[], horizon=3)
    assert len(metrics["calibration"]["left_out"]) == 2
    assert "calibration without 'swing_2' left out" in said


def test_a_test_run_that_is_too_short_is_refused_before_the_first_step(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"swing_1\) are too short.*hold out longer"):
        run([8.0, 0.08], tmp_path, test=[1])
    assert not (tmp_path / "checkpoints").exists()


def test_data_without_a_training_window_are_refused_with_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="Shorten `horizon`"):
        run([0.5, 6.0], tmp_path, test=[1], horizon=100)


@pytest.mark.slow
def test_a_training_says_what_matters_in_twenty_lines_and_all_when_asked(tmp_path: Path) -> None:
    _, said = run([6.0, 6.0, 6.0], tmp_path, test=None)
    assert len(said.splitlines()) <= 22
    some = ("declared parameter", "held out: swing_2", "in 90% interval", "verbose=true prints all tables")
    for word in some:
        assert word in said
    _, all_of_it = run([6.0, 6.0, 6.0], tmp_path, test=None, verbose=True)  # its fits are kept there
    for word in ("channel", "held-out rate of", "constant velocity", "50% interval", "CRPS"):
        assert word in all_of_it
        assert word not in said


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


def test_declared_parameters_that_the_user_gave_keep_their_values() -> None:
    spec = SDESpec("hexacopter", dt=0.05, horizon=20, step="milstein")
    model = NeuralSDE(spec, generator=torch.Generator().manual_seed(0), values={"roll_gain": 33.0})
    rng = np.random.default_rng(0)
    x = model.project(torch.from_numpy(rng.standard_normal((200, 13))).float()).detach().numpy()
    runs = [Run("shaken", 0.05 * np.arange(200), x, rng.uniform(size=(200, 6)))]
    prepare(model, runs, Windows(runs, 0.05, 20), clock_scale=1.0, given=["roll_gain"])
    assert float(model.system.value("roll_gain").detach()) == pytest.approx(33.0)
