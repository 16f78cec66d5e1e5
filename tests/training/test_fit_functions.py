"""Residual networks from functions that the likelihood chose."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

import nsde_torch
from nsde_torch.data import Run
from nsde_torch.effects import Port
from nsde_torch.models.neural_sde import NeuralSDE
from nsde_torch.training.fit_innovations import _signals, _slopes
from tests.inference.springs import TRUTH, B, rubbing, small_runs


def trained(tmp_path: Path, runs: list[Run]) -> tuple[NeuralSDE, dict[str, object]]:
    model = nsde_torch.train(runs, system="mass_spring_damper", run_dir=tmp_path / "run", say=False)
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text(encoding="utf-8"))
    network = next(m for m in model.modules() if isinstance(m, NeuralSDE))
    return network, metrics["innovations"]["networks"]["force"]


def test_the_network_sees_the_variable_of_the_law_and_fades_beyond_the_data(tmp_path: Path) -> None:
    machine = replace(rubbing(0.0), effects={"quadratic": {"size": 0.1}})
    runs = small_runs(machine, 4, 10.0, seed=3)
    model, told = trained(tmp_path, runs)
    assert told["kept"]
    assert told["variables"] == ["q_dot"]
    fastest = max(float(np.abs(run.x[:, 1]).max()) for run in runs)

    @torch.no_grad()
    def force(q: float, v: float) -> float:
        return float(model.residual(torch.tensor([[q, v]]))[Port.FORCE])

    assert force(0.0, 0.5 * fastest) == force(1.0, 0.5 * fastest)
    damping = float(model.system.all_declared()[B][0])
    for v in (-0.7 * fastest, 0.3 * fastest, 0.7 * fastest):
        true = -TRUTH[B] * v - 0.1 * abs(v) * v
        assert force(0.0, v) - damping * v == pytest.approx(true, abs=0.08 * fastest)
    assert abs(force(0.0, 4.0 * fastest)) < abs(force(0.0, 0.9 * fastest))


def test_slopes_of_a_network_are_those_of_autograd() -> None:
    generator = torch.Generator().manual_seed(0)
    widths = [3, 5, 4, 2]
    size = sum(m * n + m for n, m in pairwise(widths))
    phi = torch.randn(size, generator=generator, dtype=torch.float64)
    y = torch.randn(7, 3, generator=generator, dtype=torch.float64)

    def outputs(phi: torch.Tensor) -> torch.Tensor:
        return _signals(phi, widths, y)[-1]

    expected = torch.autograd.functional.jacobian(outputs, phi)
    torch.testing.assert_close(_slopes(phi, widths, _signals(phi, widths, y)[:-1]), expected)


def test_where_nothing_is_missing_the_network_is_silent(tmp_path: Path) -> None:
    model, told = trained(tmp_path, small_runs(rubbing(0.0), 4, 8.0, seed=1))
    assert not told["kept"]
    with torch.no_grad():
        assert float(model.residual(torch.randn(20, 2))[Port.FORCE].abs().max()) == 0.0
