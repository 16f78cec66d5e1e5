"""`nsde train model=ensemble` end to end: what it writes, that it loads and samples, resumes and sweeps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

import nsde_torch
from nsde_torch.cli.main import main
from nsde_torch.errors import ConfigError
from nsde_torch.models import GaussianEnsemble

FAST = (
    "model=ensemble",
    "model.steps=20",
    "trainer.validate_every=5",
    "trainer.patience=1000",
    "trainer.checkpoint_every=5",
    "threads=1",
)
UNTESTED = ("system=mass_spring_damper", "data.durations=[10]", "data.test=[]")
PICTURES = {"calibration", "data_summary", "held_out_errors", "held_out_rollouts", "learning_curves"}


def train(folder: Path, *words: str) -> dict[str, Any]:
    assert main(["train", *FAST, f"run_dir={folder}", *words]) == 0
    metrics: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return metrics


@pytest.mark.parametrize(
    ("system", "durations", "dt"),
    [("cartpole", "[4,4,4]", 0.02), ("hexacopter", "[5,5]", 0.05), ("mass_spring_damper", "[5,5]", 0.01)],
)
@pytest.mark.slow
def test_it_trains_saves_loads_samples_and_is_scored_on_every_system(
    system: str, durations: str, dt: float, tmp_path: Path
) -> None:
    metrics = train(tmp_path / "run", f"system={system}", f"data.durations={durations}")
    assert (metrics["model"], metrics["loss"], metrics["steps"]) == ("ensemble", "likelihood", 20)
    assert metrics["parameters"] == {}
    assert metrics["calibration"] == {"factor": 1.0}
    assert metrics["polish_steps"] == 0
    assert len(metrics["members"]["validation"]) == 5
    test = metrics["test"]
    assert test["diverged"] == 0
    assert set(test["errors"]) == {"model", "hold", "constant_velocity"}
    assert {file.stem for file in (tmp_path / "run" / "plots").iterdir()} == PICTURES
    model = nsde_torch.load(tmp_path / "run")
    assert isinstance(model, GaussianEnsemble)
    x0 = model.project(torch.ones(2, model.system.nx))
    u = torch.full((2, 3, model.system.nu), 0.4)
    path = model.sample(x0, u, dt=dt, particles=4, generator=torch.Generator().manual_seed(0))
    assert path.shape == (4, 2, 4, model.system.nx)
    assert bool(torch.isfinite(path).all())
    with pytest.raises(ConfigError, match=r"`dt` must be"):
        model.sample(x0, u, dt=2 * dt, particles=1, generator=torch.Generator())


def test_the_keys_of_the_group_reach_the_model_and_what_does_not_apply_is_let_be(tmp_path: Path) -> None:
    words = ("model.members=2", "model.hidden=[8]", "model.batch=7", "model.propagation=redrawn")
    train(tmp_path / "run", *UNTESTED, "dtype=float64", "loss=paper", "solver=rk4", *words)
    model = nsde_torch.load(tmp_path / "run")
    assert isinstance(model, GaussianEnsemble)
    spec = model.spec
    assert (spec.members, spec.hidden, spec.batch, spec.propagation) == (2, (8,), 7, "redrawn")
    assert model.low.dtype == torch.float64


@pytest.mark.slow
def test_effects_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("system=hexacopter", "data.durations=[8,8]", "system.effects=[linear_drag]")
    assert main(["train", *FAST, f"run_dir={tmp_path / 'run'}", *words]) == 2
    said = capsys.readouterr()
    assert "Leave system.effects out" in said.out + said.err


def test_a_finished_run_resumed_ends_in_the_same_metrics(tmp_path: Path) -> None:
    first = train(tmp_path / "run", *UNTESTED)
    (tmp_path / "run" / "metrics.json").unlink()
    assert main(["train", f"resume={tmp_path / 'run'}"]) == 0
    again = json.loads((tmp_path / "run" / "metrics.json").read_text())
    del first["seconds"], again["seconds"]
    assert first == again


@pytest.mark.slow
def test_it_is_swept_and_ranked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = (*UNTESTED, f"sweep_dir={tmp_path / 'sweep'}")
    assert main(["train", "-m", *FAST, *words, "model.propagation=fixed,redrawn"]) == 0
    capsys.readouterr()
    assert main(["sweep-report", str(tmp_path / "sweep")]) == 0
    said = capsys.readouterr().out
    assert "2 done" in said
    assert "model.propagation=redrawn" in said
