"""Figures show what they are given: panels, labels with units, finite limits; those of the data, and of comparisons."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from nsde_torch import plots
from nsde_torch.data import Run
from nsde_torch.plots import (
    calibration_curve,
    data_summary,
    horizon_errors,
    learning_curves,
    rollout_bands,
    save,
)
from nsde_torch.plots.data_figure import roll_pitch_yaw
from nsde_torch.plots.evaluation import policy_rewards
from nsde_torch.plots.style import RED
from nsde_torch.systems import SYSTEMS
from tests.helpers.flights import flight

pytestmark = pytest.mark.drawn

Array = NDArray[np.float64]


def panels(figure: Any) -> list[Any]:
    """Axes with a label on either side: no colour bars, no legends."""
    return [ax for ax in figure.axes if ax.get_label() != "<colorbar>"]


def assert_sound(figure: Any, path: Path) -> None:
    """Drawn without a warning, with finite limits, and every panel's lowest and leftmost axes labelled."""
    save(figure, path)
    assert path.stat().st_size > 5000
    for ax in panels(figure):
        assert np.isfinite([*ax.get_xlim(), *ax.get_ylim()]).all()
        for text in (ax.get_xlabel(), ax.get_ylabel()):
            assert not text or "[" in text or text == "gradient step", text


# ---- learning curves ----------------------------------------------------------------------------------


def history(steps: int = 300) -> list[dict[str, float | None]]:
    rows: list[dict[str, float | None]] = []
    for k in range(steps):
        fall = 3 * np.exp(-k / 60)
        terms = {"loss": fall + 0.4, "data": fall + 0.3, "gradient": 0.1 * np.exp(-k / 90), "mu": 0.001 * k}
        rows.append({"step": k, **terms, "validation": None if k % 20 else 1.0 + (k - 140) ** 2 / 1e4})
    return rows


def test_learning_curves_show_terms_and_mark_the_best_validation(tmp_path: Path) -> None:
    figure = learning_curves(history())
    assert_sound(figure, tmp_path / "a.png")
    left, right = panels(figure)
    assert left.get_yscale() == right.get_yscale() == "log"
    assert "kept: step 140" in [line.get_label() for line in left.lines]
    assert [line.get_label() for line in right.lines][:3] == ["data", "gradient", "mu"]


# ---- rollouts -----------------------------------------------------------------------------------------


def test_rollouts_of_a_multirotor_show_angles_instead_of_the_quaternion(tmp_path: Path) -> None:
    system = SYSTEMS["hexacopter"]
    _, x, _ = flight(2.0)
    measured = np.stack([x[:21], x[50:71]])
    samples = measured[:, None] + 0.01 * np.random.default_rng(0).normal(size=(2, 30, 21, 13))
    states = {"names": system.state_names, "units": system.state_units, "quaternion": system.quaternion}
    columns = {name: (0.01 * np.arange(21), measured[k], samples[k]) for k, name in enumerate("ab")}
    figure = rollout_bands(columns, title="two starts", **states)
    assert_sound(figure, tmp_path / "a.png")
    axes = panels(figure)
    assert len(axes) == 12 * 2
    labels = [ax.get_ylabel() for ax in axes if ax.get_ylabel()]
    assert labels[6:9] == ["roll [°]", "pitch [°]", "yaw [°]"]
    assert labels[0] == "p_x [m]"
    assert not any("q_" in text for text in labels)


def test_bands_hold_their_share_of_the_samples() -> None:
    rng = np.random.default_rng(0)
    samples = rng.normal(size=(4000, 3, 1))
    columns = {"": (np.arange(3.0), np.zeros((3, 1)), samples)}
    figure = rollout_bands(columns, names=["q"], units=["m"], title="normal")
    (ax,) = panels(figure)
    widths = {band.get_label(): np.ptp(band.get_paths()[0].vertices[:, 1]) / 2 for band in ax.collections}
    assert widths["95 %"] == pytest.approx(1.96, abs=0.1)
    assert widths["90 %"] == pytest.approx(1.645, abs=0.1)
    assert widths["50 %"] == pytest.approx(0.674, abs=0.05)


def test_angles_agree_with_another_library_and_do_not_jump() -> None:
    scipy = pytest.importorskip("scipy.spatial.transform")
    yaw = np.linspace(0, 3 * np.pi, 200)
    made = scipy.Rotation.from_euler("ZYX", np.stack([yaw, 0.3 * np.sin(yaw), 0.5 * np.cos(yaw)], 1))
    q = np.roll(made.as_quat(), 1, axis=1)
    q[::2] *= -1  # q and -q are one attitude
    angles = roll_pitch_yaw(q)
    np.testing.assert_allclose(angles[:, 2], np.degrees(yaw), atol=1e-9)
    np.testing.assert_allclose(angles[:, 1], np.degrees(0.3 * np.sin(yaw)), atol=1e-9)
    np.testing.assert_allclose(angles[:, 0], np.degrees(0.5 * np.cos(yaw)), atol=1e-9)


# ---- calibration and errors ---------------------------------------------------------------------------


def test_calibration_has_the_diagonal_the_target_and_a_curve_a_group(tmp_path: Path) -> None:
    levels = [0.95, 0.5, 0.9]
    figure = calibration_curve(levels, {"position": [0.9, 0.5, 0.8], "rate": [0.99, 0.6, 0.95]})
    assert_sound(figure, tmp_path / "a.png")
    (ax,) = panels(figure)
    curves = {line.get_label(): line.get_xydata() for line in ax.lines}
    np.testing.assert_allclose(curves["position"], [[0.5, 0.5], [0.9, 0.8], [0.95, 0.9]])
    assert set(curves) == {"ideal", "position", "rate"}
    low, high = ax.collections[0].get_paths()[0].vertices[:, 1].min(), 0.95
    assert (low, high) == (0.85, 0.95)


def test_errors_have_a_panel_a_group_and_name_the_baselines(tmp_path: Path) -> None:
    horizons = [0.1, 0.5, 1.0]
    errors = {
        "neural SDE": {"position": [0.01, 0.1, 0.4], "velocity": [0.1, 0.2, 0.4], "rate": [0.1, 0.2, 0.3]},
        "hold": {"position": [0.1, 0.5, 0.9], "velocity": [0.2, 0.7, 1.4], "rate": [0.3, 0.8, 1.1]},
        "constant_velocity": {"position": [0.01, 0.2, 0.6]},
    }
    figure = horizon_errors(horizons, errors, {"position": "m", "velocity": "m/s", "rate": "rad/s"})
    assert_sound(figure, tmp_path / "a.png")
    first, second, third, empty = panels(figure)
    assert first.get_ylabel() == "position error [m]"
    assert third.get_ylabel() == "rate error [rad/s]"
    assert not empty.axison
    named = ["neural SDE", "hold the last state", "constant velocity"]
    assert [line.get_label() for line in first.lines] == named
    assert len(second.lines) == 2
    assert [tick.get_text() for tick in first.get_xticklabels()] == ["0.1", "0.5", "1"]


# ---- data ---------------------------------------------------------------------------------------------


def dataset(*runs: Run, inputs: tuple[str, ...]) -> Any:
    return SimpleNamespace(runs=runs, input_names=inputs)


def gaps(figure: Any) -> int:
    return sum(line.get_gid() == "gap" for ax in panels(figure) for line in ax.lines)


def test_flights_show_speed_and_angles_with_their_95_percent_and_maximum(tmp_path: Path) -> None:
    system = SYSTEMS["hexacopter"]
    whole, cut = ((0, 501),), ((0, 200), (200, 501))
    runs = [Run(f"flight {k}", *flight(5.0, seed=k), cut if k == 1 else whole) for k in range(3)]
    figure = data_summary(dataset(*runs, inputs=system.input_names), system)  # type: ignore[arg-type]
    assert_sound(figure, tmp_path / "a.png")
    axes = panels(figure)
    assert len(axes) == 4 * 3
    assert [ax.get_ylabel() for ax in axes[::3]] == ["speed [m/s]", "roll [°]", "pitch [°]", "yaw [°]"]
    speed = np.concatenate([np.linalg.norm(run.x[:, 3:6], axis=1) for run in runs])
    text = axes[0].texts[0].get_text()
    assert f"{np.quantile(speed, 0.95):.2f}" in text
    assert f"{speed.max():.2f} m/s" in text
    assert gaps(figure) == 4
    assert "3 runs, 15.0 s" in figure.get_suptitle()


@pytest.mark.parametrize("n_runs", [3, 40])
def test_other_systems_show_states_inputs_and_a_phase_portrait_a_position(
    n_runs: int, tmp_path: Path
) -> None:
    system = SYSTEMS["cartpole"]
    rng = np.random.default_rng(0)
    t = 0.02 * np.arange(120)
    drawn = [(rng.normal(size=(120, 4)).cumsum(0), rng.normal(size=(120, 1))) for _ in range(n_runs)]
    runs = [Run(f"run {k}", t, x, u, ((0, 50), (60, 120))) for k, (x, u) in enumerate(drawn)]
    figure = data_summary(dataset(*runs, inputs=("force",)), system)  # type: ignore[arg-type]
    assert_sound(figure, tmp_path / "a.png")
    labels = [ax.get_ylabel() for ax in panels(figure)]
    assert labels[:5] == ["x [m]", "x_dot [m/s]", "theta [rad]", "theta_dot [rad/s]", "force [N]"]
    assert labels[5:] == ["x_dot [m/s]", "theta_dot [rad/s]"]
    assert gaps(figure) == (5 * n_runs if n_runs <= 4 else 0)


# ---- all ----------------------------------------------------------------------------------------------


def test_the_package_imports_no_matplotlib_and_figures_no_pyplot(tmp_path: Path) -> None:
    code = (
        "import sys; import nsde_torch.plots as p; assert 'matplotlib' not in sys.modules; "
        "p.save(p.learning_curves([{'step': 0, 'loss': 1.0}]), 'a.png'); "
        "assert 'matplotlib.pyplot' not in sys.modules; assert 'torch' not in sys.modules"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert done.returncode == 0, done.stderr


LEVELS = [0.1, 0.5, 0.9]
HORIZONS = [0.1, 1.0]
GROUPS = ["position", "velocity"]


def calibration(models: list[str]) -> object:
    share, later = ({m: dict.fromkeys(GROUPS, values) for m in models} for values in (LEVELS, [0.9, 0.8]))
    return plots.calibration_of_models(LEVELS, share, horizons=HORIZONS, per_horizon=later)


def test_a_warning_and_the_names_it_is_about_are_red() -> None:
    figure = calibration(["a", "b"])
    plots.warn(figure, "No test: b", ["b"])
    assert figure.get_suptitle().endswith("\nNo test: b")
    colours = {t.get_text(): t.get_color() for t in figure.legends[0].get_texts()}
    assert colours["b"] == RED
    assert colours["a"] != RED


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
