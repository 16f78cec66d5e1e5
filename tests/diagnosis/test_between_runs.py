"""An encoder whose zero differs from run to run is named with its runs and its value; runs that share one are not."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import nsde_torch
from nsde_torch.data import DataSet, Run
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.explanation import RunZeros, between_runs
from nsde_torch.diagnosis.search import search_in
from nsde_torch.errors import ConfigError
from nsde_torch.simulation.generate import simulate
from nsde_torch.systems import System, make_system

HOME = "double_pendulum:DoublePendulum"


@pytest.fixture(scope="module")
def folder(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of the double pendulum, by its own simulator."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(root / "examples" / "double_pendulum")
        maker = importlib.import_module("make_data")
        out = tmp_path_factory.mktemp("zeros")
        push = maker.friction(np.array([0.02, 0.01]), np.zeros(2))
        maker.write(out, push, seed=21, runs=4, seconds=8.0)
    return out


@pytest.fixture(autouse=True)
def _importable(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(root / "examples" / "double_pendulum")


def off(data: DataSet, column: int, by: Mapping[str, float]) -> list[Run]:
    """Runs in some of which a state reads too much."""
    out = []
    for run in data.runs:
        x = run.x.copy()
        x[:, column] += by.get(run.name, 0.0)
        out.append(replace(run, x=x))
    return out


def looked(system: System, runs: list[Run]) -> RunZeros | None:
    """What is said of runs by the declared physics with dry friction in both joints."""
    regression = search_in(system, runs, 1.0, Options()).base(system).regression
    return between_runs(regression, [run.name for run in runs], tie=3.0)


@pytest.mark.parametrize(("state", "column"), [("q1", 0), ("q2", 1)])
def test_a_zero_that_differs_is_named_with_its_runs_and_its_size(
    state: str, column: int, folder: Path
) -> None:
    system = make_system(HOME, effects=["coulomb_friction[q1]", "coulomb_friction[q2]"])
    data = nsde_torch.read(folder, system=HOME)
    found = looked(system, off(data, column, {"run_1": 0.12, "run_3": -0.08}))
    assert found is not None
    assert (found.state, found.unit) == (state, "rad")
    assert found.values["run_1"][0] == pytest.approx(0.12, abs=0.03)
    assert found.values["run_3"][0] == pytest.approx(-0.08, abs=0.03)
    assert "run_1" in found.sentence
    assert found.remedy.startswith("data.sensor_bias={run_")


def test_runs_that_share_their_zeros_are_silent(folder: Path) -> None:
    system = make_system(HOME, effects=["coulomb_friction[q1]", "coulomb_friction[q2]"])
    data = nsde_torch.read(folder, system=HOME)
    assert looked(system, list(data.runs)) is None
    shared = {run.name: 0.1 for run in data.runs}
    found = looked(system, off(data, 0, shared))
    assert found is None or max(abs(v) for v, _ in found.values.values()) < 0.02


def test_on_a_linear_spring_a_zero_and_a_push_are_one_and_both_are_named() -> None:
    made = simulate("mass_spring_damper", seed=4, durations=[8.0] * 4)
    data = nsde_torch.read(made, system="mass_spring_damper")
    found = looked(make_system("mass_spring_damper"), off(data, 0, {"run_2": 0.1}))
    assert found is not None
    assert found.values["run_2"][0] == pytest.approx(0.1, abs=0.02)
    assert "a steady push on the motion" in found.sentence


def test_a_reader_takes_out_what_one_run_reads_too_much(folder: Path) -> None:
    plain = nsde_torch.read(folder, system=HOME)
    data = nsde_torch.read(
        folder, system=HOME, options={"sensor_bias": {"run_1": {"q1": 0.12, "q2": 0.02}, "q2": 0.01}}
    )
    for before, after in zip(plain.runs, data.runs, strict=True):
        assert np.allclose(before.x[:, 0] - after.x[:, 0], 0.12 if before.name == "run_1" else 0.0)
        # what holds in all runs, and what is said of this one
        assert np.allclose(before.x[:, 1] - after.x[:, 1], 0.03 if before.name == "run_1" else 0.01)


def test_a_run_that_is_not_there_is_refused(folder: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"`sensor_bias` names 'run_9', which is no run; runs are run_0, run_1"
    ):
        nsde_torch.read(folder, system=HOME, options={"sensor_bias": {"run_9": {"q1": 0.12}}})
