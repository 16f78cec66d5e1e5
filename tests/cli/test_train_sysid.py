"""`nsde train model=sysid` end to end: what it writes and says, that it loads, samples, resumes, sweeps, evaluates."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

import nsde_torch
from nsde_torch.cli.main import main
from nsde_torch.models import IdentifiedModel

PICTURES = {"data_summary", "held_out_errors", "held_out_rollouts"}
SPRING = ("system=mass_spring_damper", "data.durations=[5,5,5]", "+data.options.force=multisine")


def train(folder: Path, *words: str) -> dict[str, Any]:
    assert main(["train", "model=sysid", "threads=1", f"run_dir={folder}", *words]) == 0
    metrics: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return metrics


@pytest.mark.parametrize(
    ("system", "durations", "dt"),
    [("cartpole", "[4,4,4,4]", 0.02), ("hexacopter", "[6,5]", 0.05), ("mass_spring_damper", "[5,5]", 0.01)],
)
@pytest.mark.slow
def test_it_trains_saves_loads_samples_and_is_scored_on_every_system(
    system: str, durations: str, dt: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    metrics = train(tmp_path / "run", f"system={system}", f"data.durations={durations}")
    said = capsys.readouterr().out
    assert "identified by weak form" in said
    assert "standard error" in said
    assert "95% interval" in said
    assert (metrics["model"], metrics["loss"]) == ("sysid", "least squares")
    found = metrics["identification"]
    assert found["rank"] <= found["parameters"] == len(found["estimates"])
    assert found["condition_number"] >= 1
    assert set(metrics["parameters"]) == {name.split("[")[0] for name in found["estimates"]}
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
    x0 = model.project(torch.ones(2, model.system.nx))
    u = torch.full((2, 3, model.system.nu), 0.4)
    path = model.sample(x0, u, dt=dt, particles=4, generator=torch.Generator().manual_seed(0))
    assert path.shape == (4, 2, 4, model.system.nx)
    assert torch.equal(path[0], path[3])


def test_what_the_data_do_not_show_is_said_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    metrics = train(tmp_path / "run", "system=mass_spring_damper", "data.durations=[5,5]")
    said = capsys.readouterr().out
    assert "not shown by the data: force_gain: nothing in the data depends on it" in said
    assert metrics["identification"]["rank"] == 2
    assert metrics["identification"]["not_shown"] == ["force_gain: nothing in the data depends on it"]
    assert metrics["parameters"]["force_gain"]["half_width_90"] == [None]


def test_the_keys_of_the_group_and_effects_and_first_values_reach_the_fit(tmp_path: Path) -> None:
    words = ("model.method=differences", "model.max_iterations=3", "solver=midpoint", "dtype=float64")
    more = ("system.effects=[constant_force]", "+system.parameters.force_gain=0.5")
    metrics = train(tmp_path / "run", *SPRING, *words, *more)
    assert metrics["identification"]["method"] == "differences"
    assert metrics["identification"]["iterations"] <= 3
    assert "constant_force.acceleration" in metrics["parameters"]
    model = nsde_torch.load(tmp_path / "run")
    assert isinstance(model, IdentifiedModel)
    spec = model.spec
    assert (spec.method, spec.max_iterations, spec.step) == ("differences", 3, "midpoint")
    assert model.clock_scale.dtype == torch.float64


def test_a_solver_for_noise_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["train", "model=sysid", f"run_dir={tmp_path}", "solver=heun", *SPRING]
    assert main(words) == 2
    said = capsys.readouterr()
    assert "`model=sysid` has no diffusion" in said.out + said.err


def test_a_method_that_does_not_exist_is_refused_with_the_choices(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["train", "model=sysid", f"run_dir={tmp_path}", *SPRING, "model.method=magic"]
    assert main(words) == 2
    said = capsys.readouterr()
    assert "`model.method` must be weak | differences" in said.out + said.err


@pytest.mark.slow
def test_a_finished_run_resumed_ends_in_the_same_metrics(tmp_path: Path) -> None:
    first = train(tmp_path / "run", *SPRING)
    (tmp_path / "run" / "metrics.json").unlink()
    assert main(["train", f"resume={tmp_path / 'run'}"]) == 0
    again = json.loads((tmp_path / "run" / "metrics.json").read_text())
    del first["seconds"], again["seconds"]
    assert first == again


@pytest.mark.slow
def test_it_is_swept_ranked_and_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sweep = tmp_path / "sweep"
    words = ("model=sysid", "threads=1", *SPRING, f"sweep_dir={sweep}", "model.method=weak,differences")
    assert main(["train", "-m", *words]) == 0
    capsys.readouterr()
    assert main(["sweep-report", str(sweep)]) == 0
    said = capsys.readouterr().out
    assert "2 done" in said
    assert "model.method=differences" in said
    weak, differences = sorted(p.parent for p in sweep.glob("*/metrics.json"))
    assert (
        main(["evaluate", f"run=['{weak}','{differences}']", f"out_dir={tmp_path / 'e'}", "names=[w,d]"]) == 0
    )
    written = json.loads((tmp_path / "e" / "evaluation.json").read_text())
    assert "w" in json.dumps(written)
    assert "deterministic" in capsys.readouterr().out


def test_options_of_a_choice_are_reached_with_dots(tmp_path: Path) -> None:
    """`data.options` is a key of data=simulated alone."""
    words = (SPRING[0], SPRING[1], SPRING[2].lstrip("+"))
    assert train(tmp_path / "run", *words)["identification"]["rank"] == 3
