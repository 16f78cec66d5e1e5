"""`nsde train model=ensemble` and `model=sysid`: what they write and say, that they load, sample, resume and sweep."""

import json
from pathlib import Path
from typing import Any

import pytest

import nsde_torch
from nsde_torch.cli.main import main
from nsde_torch.models import IdentifiedModel

ENSEMBLE = (
    *("model=ensemble", "model.steps=20", "threads=1", "trainer.patience=1000"),
    *("trainer.validate_every=5", "trainer.checkpoint_every=5"),
)
SYSID = ("model=sysid", "threads=1")
UNTESTED = ("system=mass_spring_damper", "data.durations=[10]", "data.test=[]")
SPRING = ("system=mass_spring_damper", "data.durations=[5,5,5]", "+data.options.force=multisine")
PICTURES = {"data_summary", "held_out_errors", "held_out_rollouts"}


def train(folder: Path, *words: str) -> dict[str, Any]:
    assert main(["train", f"run_dir={folder}", *words]) == 0
    metrics: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return metrics


@pytest.mark.parametrize(
    ("system", "durations"),
    [("cartpole", "[4,4,4]"), ("hexacopter", "[6,5]"), ("mass_spring_damper", "[5,5]")],
)
@pytest.mark.slow
def test_an_identified_model_trains_saves_loads_and_is_scored(
    system: str, durations: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    metrics = train(tmp_path / "run", *SYSID, f"system={system}", f"data.durations={durations}")
    said = capsys.readouterr().out
    for word in ("identified by weak form", "standard error", "95% interval"):
        assert word in said
    assert (metrics["model"], metrics["loss"]) == ("sysid", "least squares")
    found = metrics["identification"]
    assert found["rank"] <= found["parameters"] == len(found["estimates"])
    assert found["condition_number"] >= 1
    assert set(metrics["parameters"]) == {name.split("[")[0] for name in found["estimates"]}
    assert isinstance(metrics["validation"]["score"], float)
    test = metrics["test"]
    assert test["diverged"] == 0
    for group in ("position", "velocity"):
        assert test["errors"]["model"][group]["0.25"] < test["errors"]["hold"][group]["0.25"]
    assert all(value == 0 for by in test["spread"].values() for value in by.values())
    assert {file.stem for file in (tmp_path / "run" / "plots").iterdir()} == PICTURES
    model = nsde_torch.load(tmp_path / "run")
    assert isinstance(model, IdentifiedModel)
    for name, (value, _) in model.system.all_declared().items():
        assert value.tolist() == pytest.approx(metrics["parameters"][name]["value"], rel=1e-5, abs=1e-6)


@pytest.mark.parametrize(
    "words", [(*ENSEMBLE, *UNTESTED), pytest.param((*SYSID, *SPRING), marks=pytest.mark.slow)]
)
def test_a_finished_run_resumed_ends_in_the_same_metrics(words: tuple[str, ...], tmp_path: Path) -> None:
    first = train(tmp_path / "run", *words)
    (tmp_path / "run" / "metrics.json").unlink()
    assert main(["train", f"resume={tmp_path / 'run'}"]) == 0
    again = json.loads((tmp_path / "run" / "metrics.json").read_text())
    del first["seconds"], again["seconds"]
    assert first == again


def test_options_of_a_choice_are_reached_with_dots(tmp_path: Path) -> None:
    """`data.options` is a key of data=simulated alone."""
    words = (SPRING[0], SPRING[1], SPRING[2].lstrip("+"))
    assert train(tmp_path / "run", *SYSID, *words)["identification"]["rank"] == 3
