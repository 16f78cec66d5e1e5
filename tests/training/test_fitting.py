"""The optimisation: exact resume, determinism, early stopping, checkpoints that do not fit."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from nsde_torch.data import Windows
from nsde_torch.errors import CheckpointError, NonFiniteError
from nsde_torch.training import LossOptions, TrainerOptions
from nsde_torch.training.fit_sde import Fit
from tests.helpers.loop_contract import LoopContract, averages_of, task_of
from tests.helpers.toy_systems import DT, Decay, Gusty, decay_runs, make_model

EVERY = {"validate_every": 3, "checkpoint_every": 2, "patience": 100}
OPTIONS = TrainerOptions(steps=12, batch=8, compile="off", polish=5, **EVERY)
FEW: dict[str, Any] = {"kind": "replay", "points": 8, "ball_samples": 3}


def make_fit(
    folder: Path, *, seed: int = 0, options: TrainerOptions = OPTIONS, gusty: bool = True, **spec: Any
) -> Fit:
    system = Gusty if gusty else Decay
    model = make_model(system, seed=seed, measurement=True, disturbance=gusty, filter_reach=2, **spec)
    windows = Windows(decay_runs(2, 20.0, sigma=0.5), DT, 5)
    train, held = windows.held_out(0.2, 2.0, torch.Generator().manual_seed(seed))
    loss = LossOptions(**FEW)
    task = task_of(model.spec, [], folder / "c", options, seed=seed, loss=loss)
    return Fit(model, train, held, windows, scale=torch.ones(1), loss=loss, task=task)


class TestFit(LoopContract):
    def make(self, folder: Path, seed: int = 0) -> Fit:
        return make_fit(folder, seed=seed)

    def test_it_takes_all_steps_and_then_those_on_all_windows(self, tmp_path: Path) -> None:
        progress = make_fit(tmp_path).run()
        assert (progress.step, progress.polished) == (12, 5)


def scripted(fit: Fit, score: Callable[[int], float]) -> None:
    fit.validate = lambda: score(fit.progress.step)  # type: ignore[method-assign]


def test_early_stopping_ends_after_the_patience_and_keeps_the_best_weights(tmp_path: Path) -> None:
    fit = make_fit(tmp_path, options=replace(OPTIONS, steps=100, patience=3, polish=0))
    scripted(fit, lambda step: abs(step - 9))  # best at step 9
    averages = averages_of(fit)
    progress = fit.run()
    assert progress.stopped
    assert (progress.best_step, progress.step, progress.best_score) == (9, 18, 0)
    for value, best in zip(fit.parameters, averages[9], strict=True):
        assert torch.equal(value, best)
    assert any(not torch.equal(a, b) for a, b in zip(averages[9], averages[18], strict=True))


def test_a_loss_that_is_not_finite_stops_with_the_step_and_the_remedy(tmp_path: Path) -> None:
    fit = make_fit(tmp_path)
    with torch.no_grad():
        fit.model.h.offset.fill_(float("nan"))
    with pytest.raises(NonFiniteError, match=r"not finite at step 1.*trainer\.lr"):
        fit.run()


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a fit that came to its end."""
    folder = tmp_path_factory.mktemp("fit")
    make_fit(folder).run()
    return folder


@pytest.fixture
def checkpoint(finished: Path, tmp_path: Path) -> Path:
    shutil.copytree(finished, tmp_path / "fit")
    return tmp_path / "fit" / "c.safetensors"


def test_checkpoints_are_safetensors_with_plain_json(checkpoint: Path) -> None:
    assert [p.name for p in checkpoint.parent.iterdir()] == ["c.safetensors"]
    with safe_open(str(checkpoint), framework="pt") as opened:
        assert json.loads(opened.metadata()["about"])["step"] == 12


@pytest.mark.parametrize("kept", [0, 7, 500, -1])
def test_a_damaged_checkpoint_is_refused_by_name_with_the_remedy(checkpoint: Path, kept: int) -> None:
    checkpoint.write_bytes(checkpoint.read_bytes()[:kept])
    with pytest.raises(CheckpointError, match=rf"{checkpoint} is damaged.*Remove it"):
        make_fit(checkpoint.parent).run()


@pytest.mark.parametrize(
    "other",
    [{"gusty": False}, {"residual_hidden": (4,)}, {"distance_hidden": (8, 8)}, {"dtype": torch.float64}],
)
def test_a_checkpoint_of_another_model_is_refused_and_says_where_it_differs(
    checkpoint: Path, other: dict[str, Any]
) -> None:
    with pytest.raises(CheckpointError, match=r"another model \(they differ in .*configuration of the run"):
        make_fit(checkpoint.parent, **other).run()


@pytest.mark.parametrize("lost", ["batches", "noise", "kept.h.offset", "its progress"])
def test_a_checkpoint_that_lacks_a_part_is_refused(checkpoint: Path, lost: str) -> None:
    with safe_open(str(checkpoint), framework="pt") as opened:
        about = None if lost == "its progress" else opened.metadata()
    tensors = {name: tensor for name, tensor in load_file(checkpoint).items() if name != lost}
    save_file(tensors, checkpoint, metadata=about)
    with pytest.raises(CheckpointError, match=str(checkpoint)):
        make_fit(checkpoint.parent).run()
