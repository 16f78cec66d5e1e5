"""Figures that compare models, and policies."""

from pathlib import Path

import numpy as np
import pytest

from nsde_torch import plots
from nsde_torch.plots import PredictionBand, evolution
from nsde_torch.plots.policy_rewards import policy_rewards
from nsde_torch.plots.style import RED, model_look

pytestmark = pytest.mark.drawn

LEVELS = [0.1, 0.5, 0.9]
HORIZONS = [0.1, 1.0]
GROUPS = ["position", "velocity"]


def calibration(models: list[str]) -> object:
    share, later = ({m: dict.fromkeys(GROUPS, values) for m in models} for values in (LEVELS, [0.9, 0.8]))
    return plots.calibration_of_models(LEVELS, share, horizons=HORIZONS, per_horizon=later)


def test_calibration_has_a_curve_for_each_model_in_the_panels_of_each_group(tmp_path: Path) -> None:
    figure = calibration(["a", "b", "c"])
    assert len(figure.axes) == 4
    for ax in figure.axes:
        assert len(ax.lines) == 3 + 1  # the diagonal, or the level
    assert {t.get_text() for t in figure.legends[0].get_texts()} == {"ideal", "a", "b", "c"}
    assert plots.save(figure, tmp_path / "c.png").stat().st_size > 5000


def rollouts(steps: dict[str, int], scale: float = 1.0) -> object:
    rng = np.random.default_rng(0)
    t = {m: np.linspace(0, 2, n + 1) for m, n in steps.items()}
    measured = {m: np.column_stack([np.sin(v), np.cos(v)]) for m, v in t.items()}
    samples = {m: measured[m] + scale * rng.standard_normal((20, *measured[m].shape)) for m in t}
    return plots.rollouts_of_models(
        t, measured, samples, names=["x", "v"], units=["m", "m/s"], title="Rollouts"
    )


def test_rollouts_of_models_of_different_steps_share_the_axis_of_a_channel(tmp_path: Path) -> None:
    figure = rollouts({"fine": 40, "coarse": 8})
    axes = np.array(figure.axes).reshape(2, 2)
    assert [ax.get_title() for ax in axes[0]] == ["fine", "coarse"]
    assert axes[0, 0].get_ylim() == axes[0, 1].get_ylim()
    assert [len(ax.lines[0].get_xdata()) for ax in axes[0]] == [41, 9]
    assert plots.save(figure, tmp_path / "r.png").stat().st_size > 5000


def test_a_band_that_runs_away_does_not_flatten_what_was_measured() -> None:
    low, high = rollouts({"a": 40}, scale=1e6).axes[0].get_ylim()
    assert high - low < 20


def test_a_warning_and_the_names_it_is_about_are_red() -> None:
    figure = calibration(["a", "b"])
    plots.warn(figure, "No test: b", ["b"])
    assert figure.get_suptitle().endswith("\nNo test: b")
    colours = {t.get_text(): t.get_color() for t in figure.legends[0].get_texts()}
    assert colours["b"] == RED
    assert colours["a"] != RED


def test_twelve_models_have_looks_of_their_own() -> None:
    looks = [tuple(map(str, model_look(k).values())) for k in range(12)]
    assert len(set(looks)) == 12


T = np.linspace(0.0, 2.0, 21)


def test_channels_of_one_unit_share_their_scale_so_that_a_still_one_looks_still() -> None:
    truth = np.stack((T, 0.01 * T, 3 * T), axis=1)
    lost = PredictionBand("a model", np.where(T[:, None] > 1, np.nan, 1e6 * truth))
    figure = evolution(T, truth, [lost], names="abc", units=("m", "m", "rad"), title="evolution")
    spans = [np.ptp(ax.get_ylim()) for ax in figure.axes]
    assert spans[0] == pytest.approx(spans[1])
    assert spans[2] == pytest.approx(3 * spans[0])
    for ax, channel in zip(figure.axes, truth.T, strict=True):
        assert ax.get_ylim()[0] < channel.min() <= channel.max() < ax.get_ylim()[1]


def curve(offset: float, every: int = 10) -> list[dict[str, float]]:
    made = range(0, 101, every)
    return [
        {"interactions": n, "truth_reward": n + offset, "environment_reward": 2 * n + offset} for n in made
    ]


def test_lines_are_means_over_seeds_and_the_spread_is_shown() -> None:
    figure = policy_rewards({"SDE": [curve(0.0), curve(10.0, every=20)], "ODE": [curve(0.0)]}, random=-5.0)
    left, right = figure.axes
    assert [ax.get_title() for ax in (left, right)] == ["SDE\n2 seeds", "ODE\n1 seed"]
    imagined, true = left.lines[:2]
    np.testing.assert_allclose(true.get_xdata(), np.arange(0, 101, 20) / 1e3)
    np.testing.assert_allclose(true.get_ydata(), np.arange(0, 101, 20) + 5.0)
    np.testing.assert_allclose(imagined.get_ydata(), 2.0 * np.arange(0, 101, 20) + 5.0)
    assert len(left.collections) == 2
    assert not right.collections


def test_references_are_named_in_the_legend() -> None:
    figure = policy_rewards({"SDE": [curve(0.0)]}, random=-5.0, truth=90.0, limited=10.0)
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    limited = "trained on as much of the truth as the models"
    assert words[2:] == ["trained on the truth", limited, "random actions"]
