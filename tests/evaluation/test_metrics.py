"""Held-out scores: against closed forms, and against an evaluation written independently of the package."""

import importlib.util
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from nsde_torch.data import Run
from nsde_torch.errors import DataError
from nsde_torch.evaluation import evaluate
from nsde_torch.evaluation.figures import Coverage, extrapolate
from nsde_torch.evaluation.metrics import horizons_of
from nsde_torch.evaluation.scores import (
    LEVELS,
    group_squares,
    interval_quantiles,
    rms_by_group,
)
from nsde_torch.models import NeuralSDE, SDESpec
from nsde_torch.models.run_directory import save
from nsde_torch.systems import make_system
from tests.helpers.draws import generator
from tests.helpers.flights import flight
from tests.helpers.toy_systems import DT, Decay, decay_runs, fix_sigma, make_model


@pytest.fixture(scope="module")
def calibrated() -> dict[str, Any]:
    """Scores of the true model of a decay with noise, on 300 s."""
    model = fix_sigma(make_model(Decay), 0.5)
    return evaluate(model, decay_runs(3, 100.0, sigma=0.5), seed=0, particles=64)


@pytest.mark.parametrize("level", LEVELS)
def test_intervals_of_the_true_model_hold_what_they_say(calibrated: dict[str, Any], level: float) -> None:
    for value in calibrated["coverage"][f"{level:g}"]["position"].values():
        assert value == pytest.approx(level, abs=0.06)


def test_scores_of_the_true_model_are_the_closed_forms(calibrated: dict[str, Any]) -> None:
    for h in calibrated["horizons_s"]:
        keep = 1 - DT
        std = 0.5 * math.sqrt(DT * (1 - keep ** (2 * round(h / DT))) / (1 - keep**2))
        entropy = 0.5 * math.log(2 * math.pi * math.e * std**2)
        key = f"{h:g}"
        assert calibrated["errors"]["model"]["position"][key] == pytest.approx(std * (1 + 1 / 128), rel=0.1)
        assert calibrated["spread"]["position"][key] == pytest.approx(std, rel=0.02)
        assert calibrated["crps"]["position"][key] == pytest.approx(std / math.sqrt(math.pi), rel=0.1)
        assert calibrated["nll"]["position"][key] == pytest.approx(entropy, abs=0.1)


@pytest.mark.parametrize(("particles", "expected"), [(9, 0.8), (19, 0.9), (32, 0.9), (999, 0.9)])
def test_interval_of_an_exchangeable_ensemble_holds_its_level(particles: int, expected: float) -> None:
    """By rank: the truth is equally likely in each of the P + 1 gaps; nine particles cannot hold more than 0.8."""
    e = torch.randn(particles, 200_000 if particles < 100 else 20_000, generator=generator())
    truth = torch.randn(e.shape[1], generator=generator(1))
    low, high = interval_quantiles((e - truth).sort(0).values, 0.9)
    held = float(((low <= 0) & (high >= 0)).float().mean())
    assert held == pytest.approx(expected, abs=0.01)


def test_baseline_errors_of_a_sine_are_the_closed_forms() -> None:
    t = 0.01 * np.arange(6284)
    run = Run("sine", t, np.stack((np.sin(t), np.cos(t)), 1), np.zeros((len(t), 1)))
    spec = SDESpec("mass_spring_damper", dt=0.01, horizon=10, step="euler_maruyama")
    model = NeuralSDE(spec, generator=generator()).requires_grad_(False)
    scores = evaluate(model, [run], seed=0, particles=2)["errors"]
    for h in (0.1, 0.5, 2.0):
        held = 2 * math.sin(h / 2) / math.sqrt(2)  # rms of sin(t + h) - sin(t)
        moving = math.sqrt(((math.cos(h) - 1) ** 2 + (math.sin(h) - h) ** 2) / 2)
        assert scores["hold"]["position"][f"{h:g}"] == pytest.approx(held, rel=0.01)
        assert scores["hold"]["velocity"][f"{h:g}"] == pytest.approx(held, rel=0.01)
        assert scores["constant_velocity"]["position"][f"{h:g}"] == pytest.approx(moving, rel=0.02)


def test_group_error_is_the_rms_of_the_norm_in_the_groups_unit() -> None:
    system = make_system("hexacopter")
    e = torch.zeros(2, 12)
    e[0, :3] = torch.tensor([3.0, 4.0, 0.0])
    e[:, 6] = math.pi / 180
    rms = rms_by_group(system, group_squares(system, e)[:, None], ["1"])
    assert rms["position"]["1"] == pytest.approx(math.sqrt(25 / 2))
    assert rms["attitude"]["1"] == pytest.approx(1.0)
    assert rms["velocity"]["1"] == 0.0


def with_gap(run: Run, at: int) -> Run:
    n = len(run)
    return Run(run.name, run.t, run.x, run.u, ((0, at), (at, n)))


def test_starts_whose_two_seconds_cross_a_gap_are_left_out_and_its_jump_does_not_enter_the_errors() -> None:
    run = decay_runs(1, 20.0, sigma=0.5)[0]
    model = fix_sigma(make_model(Decay), 0.5)
    # 0, 0.25, ... 18 s: two seconds after the last start is the last row
    assert evaluate(model, [run], seed=0)["starts"] == 73
    inside = [k for k in range(0, 361, 5) if k + 40 < 200 or k >= 200]
    x = np.array(run.x)
    x[200:] += 1e4
    scores = evaluate(model, [with_gap(Run("jump", run.t, x, run.u), 200)], seed=0)
    assert scores["starts"] == len(inside) == 65
    assert max(scores["errors"]["hold"]["position"].values()) < 10


def test_horizons_are_those_that_the_longest_stretch_holds() -> None:
    (run,) = decay_runs(1, 1.2, sigma=0.5)
    assert horizons_of([run], DT) == (0.1, 0.25, 0.5, 1.0)
    assert horizons_of([with_gap(run, 12)], DT) == (0.1, 0.25, 0.5)


@pytest.mark.parametrize(
    ("dt", "pace", "horizons"),
    [
        (5.0, 150.0, (10.0, 25.0, 50.0, 100.0, 200.0)),
        (5.0, 1.0, (5.0, 10.0, 20.0)),  # a reactor whose inflow is changed at each row
        (0.1, 4.0, (0.1, 0.25, 0.5, 1.0, 2.0)),
        (1e-4, 0.05, (0.01, 0.025, 0.05, 0.1, 0.2)),
    ],
)
def test_horizons_are_as_long_as_the_machine_is_slow(
    dt: float, pace: float, horizons: tuple[float, ...]
) -> None:
    rows = np.zeros((6000, 1))
    assert horizons_of([Run("r", dt * np.arange(6000.0), rows, rows, pace=pace)], dt) == horizons


def test_runs_that_are_too_short_are_refused_in_words() -> None:
    with pytest.raises(DataError, match="longer runs"):
        evaluate(make_model(Decay), decay_runs(1, 0.1, sigma=0.5), seed=0)


def test_only_the_starts_without_a_finite_prediction_count_as_diverged() -> None:
    (run,) = decay_runs(1, 20.0, sigma=0.5)
    u = np.zeros((401, 1))
    u[100:110] = 3e38  # beyond float32 in the second step that sees it
    model = fix_sigma(make_model(Decay), 0.5)
    model.system.set_value("rate", torch.tensor([30.0]))
    bad = Run("bad", run.t, np.zeros_like(run.x), u)
    result = evaluate(model, [bad], seed=0)
    hit = [k for k in range(0, 361, 5) if 60 < k < 109]
    assert result["diverged"] == len(hit)
    for by_horizon in result["errors"]["model"].values():
        assert all(math.isfinite(v) for v in by_horizon.values())


# ---- against the evaluation beside the checkout ---------------------------------------------------------


@pytest.fixture(scope="module")
def outside() -> ModuleType:
    """The evaluation script that stands beside the checkout; it shares no code with the package."""
    file = Path(__file__).resolve().parents[2].parent / "shared" / "tools" / "eval_rollout.py"
    if not file.is_file():
        pytest.skip("needs ../shared/tools/eval_rollout.py")
    spec = importlib.util.spec_from_file_location("eval_rollout", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("gap", [False, True])
@pytest.mark.parametrize("full", [False, True])
def test_scores_agree_with_an_independent_evaluation(
    outside: ModuleType, tmp_path: Path, gap: bool, full: bool
) -> None:
    t, x, u = flight(30.0, seed=3)
    segments: tuple[tuple[int, int], ...] = ()
    if gap:
        x[1500:, :3] += 1.0  # a time gap shows as a jump of the position
        segments = ((0, 1500), (1500, len(t)))
    run = Run("flight", t, x, u, segments)
    spec = SDESpec(
        "hexacopter", dt=0.05, horizon=20, step="milstein", measurement=full, disturbance=full, filter_reach=4
    )
    model = NeuralSDE(spec, generator=generator()).requires_grad_(False)
    model.log_measurement_std.fill_(-4.0)
    assert model.filter is not None
    model.filter.weights.normal_(generator=generator(2)).mul_(0.05)
    save(model, tmp_path)
    theirs = outside.evaluate(outside.nsde_run(str(tmp_path)), x, u, n_particles=32, seed=5)
    ours = evaluate(model, [run], seed=5, particles=32)
    assert theirs["n_starts"] == ours["starts"]
    names = {"position": "pos_rmse", "velocity": "vel_rmse", "attitude": "att_rmse", "rate": "rate_rmse"}
    channels = dict(zip(model.system.error_names, outside.CH, strict=True))
    for h, scores in theirs["horizons"].items():
        for group, key in names.items():
            assert ours["errors"]["model"][group][h] == pytest.approx(scores[key], rel=2e-3)
        for own, other in channels.items():
            assert ours["coverage_channels"][own][h] == pytest.approx(scores["cov90"][other], abs=0.021)
        for g in model.system.error_groups:
            at = [list(channels.values())[k] for k in g.channels]
            for own, other in (("crps", "crps"), ("spread", "spread")):
                expected = np.mean([scores[other][c] for c in at]) * g.factor
                assert ours[own][g.name][h] == pytest.approx(expected, rel=3e-3)
    held = outside.evaluate(outside.baseline("hold"), x, u)["horizons"]
    moving = outside.evaluate(outside.baseline("cv"), x, u)["horizons"]
    for h in held:
        for group, key in names.items():
            assert ours["errors"]["hold"][group][h] == pytest.approx(held[h][key], rel=1e-4)
            assert ours["errors"]["constant_velocity"][group][h] == pytest.approx(moving[h][key], rel=1e-4)


SIGMA = 0.5


@pytest.fixture(scope="module")
def runs() -> list[Run]:
    """300 s of a decay with noise."""
    return decay_runs(3, 100.0, sigma=SIGMA)


def test_coverage_rises_with_the_factor_is_nine_tenths_at_the_truth_and_one_where_paths_diverge(
    runs: list[Run],
) -> None:
    coverage = Coverage(fix_sigma(make_model(Decay), SIGMA), runs, seed=0, compile=False)
    values = [coverage(f) for f in (-1.0, -0.3, 0.0, 0.3, 1.0)]
    assert values == sorted(values)
    assert values[2] == pytest.approx(0.9, abs=0.04)
    assert coverage(300.0) == 1.0


def test_extrapolation_takes_the_share_of_the_excess_that_a_new_run_still_sees() -> None:
    assert extrapolate(0.2, [], 1) == 0.2
    for n in (2, 3, 10):
        assert extrapolate(0.1, [0.4, 0.6, 0.5], n) == pytest.approx(0.1 + 0.4 * (n - 1) / n)

    assert extrapolate(0.3, [0.0, 0.1], 2) == 0.3  # a run left out never narrows
