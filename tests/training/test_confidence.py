"""Confidence of declared parameters: intervals hold the truth as often as they say, and say when nothing is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from nsde_torch.data import Run, Windows
from nsde_torch.models import NeuralSDE, SDESpec
from nsde_torch.training.fit_sde import _quantile, declared_confidence

DT, STIFFNESS, DAMPING = 0.05, 4.0, 0.5
NAMES = ("linear_spring.stiffness", "viscous_friction.damping")


def spring_run(seed: int, seconds: float = 60.0, push: float = 0.0) -> Run:
    """A spring shaken by white noise, seen exactly; finely integrated, kept every DT."""
    rng = np.random.default_rng(seed)
    fine = 10
    dt = DT / fine
    n = round(seconds / DT)
    kicks = 0.3 * math.sqrt(dt) * rng.standard_normal((n, fine))
    u = push * rng.standard_normal(n + 1)
    x = np.empty((n + 1, 2))
    q, v = rng.standard_normal(2) * np.array([0.15, 0.3])
    for k in range(n + 1):
        x[k] = q, v
        if k == n:
            break
        for kick in kicks[k]:
            v = v + dt * (u[k] - STIFFNESS * q - DAMPING * v) + kick
            q = q + dt * v
    return Run("swing", DT * np.arange(n + 1), x, u[:, None])


def make() -> NeuralSDE:
    spec = SDESpec("mass_spring_damper", dt=DT, horizon=10, step="euler_maruyama")
    model = NeuralSDE(
        spec, generator=torch.Generator().manual_seed(0), values={NAMES[0]: STIFFNESS, NAMES[1]: DAMPING}
    )
    with torch.no_grad():
        for network in model.residuals.values():
            network.layers[-1].weight.zero_()  # type: ignore[union-attr, operator, index]
    return model.double().requires_grad_(False)


def fit(model: NeuralSDE, windows: Windows) -> None:
    """Gauss-Newton on the noise-free prediction over a quarter of a second, all windows."""
    x, u, _ = windows.batch(torch.arange(len(windows)))
    raws = [e.raw[n] for e, n in zip(model.system.effects, ("stiffness", "damping"), strict=True)]  # type: ignore[union-attr, index]

    def errors() -> Tensor:
        return (model.paths(x[:, 0], u[:, :5], dt=DT, noise=None)[0, :, 5] - x[:, 5]).reshape(-1)

    for _ in range(3):
        base, columns = errors(), []
        for raw in raws:
            raw.add_(1e-4)
            columns.append((errors() - base) / 1e-4)
            raw.sub_(1e-4)
        step = torch.linalg.lstsq(torch.stack(columns, 1), base[:, None]).solution[:, 0]
        for raw, change in zip(raws, step, strict=True):
            raw.sub_(change)


@pytest.mark.slow
def test_ninety_per_cent_intervals_hold_the_true_parameters_about_that_often() -> None:
    """Fifteen clusters. Eight (4 runs of 5 s) still held only 82 % of 160 when this was written."""
    held = []
    for seed in range(60):
        model = make()
        windows = Windows([spring_run(seed)], DT, 10, dtype=torch.float64)
        fit(model, windows)
        found = declared_confidence(model, windows, torch.ones(2, dtype=torch.float64))
        for name, truth in zip(NAMES, (STIFFNESS, DAMPING), strict=True):
            (value,), (half,) = found[name]["value"], found[name]["half_width_90"]  # type: ignore[misc]
            held.append(abs(value - truth) <= half)
    assert 0.8 <= np.mean(held) <= 0.98


@pytest.mark.parametrize(("clusters", "expected"), [(2, 6.314), (8, 1.895), (100_000, 1.645)])
def test_few_clusters_take_students_quantile(clusters: int, expected: float) -> None:
    assert _quantile(clusters) == pytest.approx(expected, abs=1e-3)


def test_a_single_cluster_gives_no_interval() -> None:
    windows = Windows([spring_run(0, 3.0)], DT, 10, dtype=torch.float64)
    found = declared_confidence(make(), windows, torch.ones(2, dtype=torch.float64))
    assert found[NAMES[0]]["half_width_90"] == [None]


def test_intervals_shrink_as_the_square_root_of_the_data() -> None:
    halves = []
    for seconds in (40.0, 160.0):
        model = make()
        windows = Windows([spring_run(0, seconds)], DT, 10, dtype=torch.float64)
        fit(model, windows)
        found = declared_confidence(model, windows, torch.ones(2, dtype=torch.float64))
        halves.append(found[NAMES[0]]["half_width_90"][0])  # type: ignore[index]
    assert 1.3 < halves[0] / halves[1] < 3.2


def test_a_parameter_that_no_prediction_depends_on_has_no_interval() -> None:
    windows = Windows([spring_run(0)], DT, 10, dtype=torch.float64)  # the force is always zero
    found = declared_confidence(make(), windows, torch.ones(2, dtype=torch.float64))
    assert found["force_gain"]["half_width_90"] == [None]
    pushed = Windows([spring_run(0, push=0.5)], DT, 10, dtype=torch.float64)
    (half,) = declared_confidence(make(), pushed, torch.ones(2, dtype=torch.float64))["force_gain"][  # type: ignore[misc]
        "half_width_90"
    ]
    assert 0 < half < 1


def test_looking_leaves_the_parameters_as_they_were() -> None:
    model = make()
    before = {k: v.clone() for k, v in model.state_dict().items()}
    declared_confidence(
        model, Windows([spring_run(0)], DT, 10, dtype=torch.float64), torch.ones(2, dtype=torch.float64)
    )
    for name, value in model.state_dict().items():
        assert torch.equal(value, before[name]), name


@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_the_scale_of_all_errors_does_not_matter(scale: float) -> None:
    windows = Windows([spring_run(0)], DT, 10, dtype=torch.float64)
    one = declared_confidence(make(), windows, torch.ones(2, dtype=torch.float64))
    other = declared_confidence(make(), windows, torch.full((2,), scale, dtype=torch.float64))
    for name in NAMES:
        assert other[name]["half_width_90"] == pytest.approx(one[name]["half_width_90"], rel=1e-3)
