"""The functions of `nsde_torch` do what the commands do, and their examples run."""

import doctest
import json
import runpy
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

import nsde_torch
from nsde_torch.cli.main import main
from nsde_torch.data import RawRun
from nsde_torch.effects import Effect
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.models import NsdeOptions
from nsde_torch.systems import MassSpringDamper, SystemOptions
from nsde_torch.training import TrainerOptions, options
from tests.helpers.leaning import leaning_flight

SYSTEM = "mass_spring_damper"
QUICK = {"steps": 3, "polish": 1, "validate_every": 2, "batch": 16, "compile": "off", "calibrate": False}


def silent(text: str) -> None:
    return None


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """CSV files of a spring with dry friction."""
    folder = tmp_path_factory.mktemp("api") / "spring"
    dry: Any = [{"coulomb_friction": {"size": 0.3}}]
    nsde_torch.simulate(SYSTEM, effects=dry, durations=[5.0] * 3, seed=1).save(folder)
    return folder


@pytest.mark.parametrize("name", ["diagnose", "evaluate", "read", "simulate", "train"])
def test_the_example_of_a_function_runs(name: str) -> None:
    function = getattr(nsde_torch, name)
    found = doctest.DocTestFinder(recurse=False).find(function, name, globs={"simulate": nsde_torch.simulate})
    examples = [test for test in found if test.examples]
    assert examples
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    for test in examples:
        runner.run(test)
    assert runner.summarize().failed == 0


@pytest.mark.parametrize("name", ["diagnose", "evaluate", "load", "read", "simulate", "train"])
def test_a_function_documents_arguments_results_and_errors(name: str) -> None:
    function = getattr(nsde_torch, name)
    assert {"Args:", "Raises:"} <= set(function.__doc__.split())
    code = function.__code__
    for argument in code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]:
        assert f"{argument}:" in function.__doc__ or f"{argument}," in function.__doc__, argument


@pytest.mark.slow
def test_python_trains_the_model_that_the_command_trains(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    friction, trainer = [{"coulomb_friction": {"size": 0.2}}], TrainerOptions(**QUICK)
    given: dict[str, Any] = {"effects": friction, "trainer": trainer, "test": [0], "seed": 3}
    model = nsde_torch.train(runs, system=SYSTEM, run_dir="python", say=silent, **given)
    words = [f"trainer.{k}={str(v).lower()}" for k, v in QUICK.items()]
    words += ["system.effects=[coulomb_friction]", "system.parameters.coulomb_friction.size=0.2"]
    words += [f"system={SYSTEM}", "data=csv", f"data.path={runs}", "data.test=[0]", "seed=3", "run_dir=shell"]
    assert main(["train", *words]) == 0
    other = nsde_torch.load("shell")
    assert model.spec == other.spec
    for name, value in model.state_dict().items():
        assert torch.equal(value, other.state_dict()[name]), name
    assert {**model.metrics, "seconds": None} == {**other.metrics, "seconds": None}
    assert model.folder == Path("python")


@pytest.mark.slow
def test_python_finds_what_the_command_finds(runs: Path, tmp_path: Path) -> None:
    names = ["coulomb_friction", "quadratic_damping"]
    found = nsde_torch.diagnose(runs, system=SYSTEM, candidates=names)
    words = [f"system={SYSTEM}", "data=csv", f"data.path={runs}", f"candidates=[{','.join(names)}]"]
    assert main(["diagnose", *words, "retrain=false", f"out_dir={tmp_path / 'shell'}"]) == 0
    page = found.save(tmp_path / "python")
    ours, theirs = (json.loads((tmp_path / k / "diagnosis.json").read_text()) for k in ("python", "shell"))
    assert {**ours, "seconds": None} == {**theirs, "seconds": None}
    assert found.verdict == "effect_found"
    assert found.added == ["coulomb_friction"] == list(found.effects)
    assert found.effects["coulomb_friction"]["size"] == pytest.approx(0.3, rel=0.1)
    assert found.parameters["coulomb_friction.size"]["unit"] == "m/s2"
    assert "coulomb_friction" in found.report
    assert "coulomb_friction" in str(found)
    assert len(str(found)) < len(found.report)
    assert page.name == "report.html"
    made, written = ({p.name for p in folder.iterdir()} for folder in (page.parent, tmp_path / "shell"))
    assert made == written - {".hydra", "diagnose.log"}


@pytest.mark.slow
def test_what_was_found_is_given_to_a_training_by_name_file_and_mapping(runs: Path, tmp_path: Path) -> None:
    file = tmp_path / "effects.yaml"
    file.write_text(f"system: {SYSTEM}\neffects: {{coulomb_friction: {{size: 0.28}}}}\n")
    for effects in (["coulomb_friction"], "coulomb_friction", file, str(file), {"coulomb_friction": {}}):
        model = nsde_torch.train(runs, system=SYSTEM, effects=effects, model="sysid", say=silent)
        size = model.metrics["parameters"]["coulomb_friction.size"]
        assert size["value"] == pytest.approx([0.3], rel=0.1)
        assert model.folder is None
    with pytest.raises(ConfigError, match="cartpole"):
        nsde_torch.diagnose(runs, system="cartpole", effects=file)


def test_a_training_and_an_evaluation_say_nothing_where_they_are_asked_to(
    runs: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    model = nsde_torch.train(runs, system=SYSTEM, model="sysid", say=False)
    nsde_torch.evaluate(model, runs, runs=[2], particles=2, bootstrap=100, say=False)
    assert capsys.readouterr() == ("", "")
    assert not caplog.records
    nsde_torch.evaluate(model, runs, runs=[2], particles=2, bootstrap=100)
    assert "scoring" in capsys.readouterr().out


@pytest.mark.slow
def test_a_calibration_shows_a_bar_in_a_notebook(
    runs: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ipykernel", ModuleType("ipykernel"))
    nsde_torch.train(runs, system=SYSTEM, trainer="fast", say=silent)
    assert "calibrating" in capsys.readouterr().err


@pytest.mark.slow
def test_evaluation_compares_models_by_their_names(runs: Path, tmp_path: Path) -> None:
    plain = nsde_torch.train(runs, system=SYSTEM, model="sysid", say=silent)
    better = nsde_torch.train(runs, system=SYSTEM, model="sysid", effects="coulomb_friction", say=silent)
    scores = nsde_torch.evaluate({"plain": plain, "better": better}, runs, runs=["run_2"], particles=2)
    assert [m["name"] for m in scores.content["models"]] == ["plain", "better"]
    assert scores.content["models"][0]["held_out"]
    assert scores.errors["position"]["0.5"] > scores.content["models"][1]["errors"]["position"]["0.5"]
    assert "better" in scores.report
    assert {file.name for file in scores.save(tmp_path / "out")} >= {"evaluation.json", "errors.png"}
    with pytest.raises(ConfigError, match="names"):
        nsde_torch.evaluate([plain, better], runs)
    with pytest.raises(ConfigError, match="sensor_noise"):
        nsde_torch.evaluate(plain, runs, sensor_noise="tets")
    with pytest.raises(ConfigError, match="no model"):
        nsde_torch.evaluate([], runs)


def test_data_come_from_folders_simulations_and_arrays(runs: Path) -> None:
    from_files = nsde_torch.read(runs, system=SYSTEM)
    arrays = [RawRun(r.name, r.t, r.x, r.u) for r in from_files.runs]
    for data in (arrays, from_files):
        again = nsde_torch.read(data, system=MassSpringDamper)
        assert again.names == from_files.names
        assert all(np.array_equal(a.x, b.x) for a, b in zip(again.runs, from_files.runs, strict=True))
    biased = nsde_torch.read(runs, system=SYSTEM, sensor_bias={"q": 0.5})
    assert np.allclose(from_files.runs[0].x[:, 0] - biased.runs[0].x[:, 0], 0.5)
    with pytest.raises(ConfigError, match="sensor_bias"):
        nsde_torch.read(arrays, system=SYSTEM, sensor_bias={"q": 0.5})
    with pytest.raises(DataError, match="nowhere"):
        nsde_torch.read("nowhere", system=SYSTEM)


@pytest.mark.slow
def test_structure_follows_the_options_that_were_given(runs: Path) -> None:
    system = SystemOptions(SYSTEM, dt=0.05, horizon=8, sigma_max=(0.1, 0.2))
    model = NsdeOptions(residual_hidden=(4,), measurement=False)
    given: dict[str, Any] = {"solver": "heun", "trainer": TrainerOptions(**QUICK), "loss": "replay"}
    spec: Any = nsde_torch.train(runs, system=system, model=model, say=silent, **given).spec
    assert (spec.dt, spec.horizon, spec.sigma_max) == (0.05, 8, (0.1, 0.2))
    assert (spec.residual_hidden, spec.measurement, spec.step, spec.loss) == ((4,), False, "heun", "replay")


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"model": "nsd"}, "`model`"), ({"loss": "crps"}, "`loss`"), ({"trainer": "slow"}, "`trainer`"),
        ({"solver": "eulr"}, "solver"), ({"dtype": "float16"}, "`dtype`"),
        ({"effects": "coulomb_fiction"}, "coulomb_fiction"), ({"parameters": {"mas": 1.0}}, "mas"),
    ],
)  # fmt: skip
def test_a_wrong_choice_is_named(given: dict[str, Any], named: str, runs: Path) -> None:
    with pytest.raises(ConfigError, match=named):
        nsde_torch.train(runs, system=SYSTEM, say=silent, **given)


def test_options_out_of_range_are_named() -> None:
    with pytest.raises(ConfigError, match=r"`trainer\.steps` must be at least 1; got 0"):
        TrainerOptions(steps=0)
    assert "largest number of gradient steps [steps] (at least 1)" in str(TrainerOptions.__doc__)


def test_a_system_of_ones_own_is_given_as_a_class(runs: Path) -> None:
    class Own(nsde_torch.System):  # type: ignore[misc]
        """Not found by name: it lies inside a function."""

    with pytest.raises(ConfigError, match="Own"):
        nsde_torch.diagnose(runs, system=Own)
    assert issubclass(MassSpringDamper, nsde_torch.System)
    assert nsde_torch.Effect is Effect


@pytest.mark.slow
def test_a_newcomer_gets_from_files_to_a_named_effect(
    runs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    root: Path,
) -> None:
    script = root / "examples" / "find_effect.py"
    code = script.read_text().split('"""')[2]
    assert len([line for line in code.splitlines() if line.strip()]) <= 15
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(options.TRAINERS, "fast", TrainerOptions(**QUICK))
    monkeypatch.setattr(sys, "argv", ["find_effect.py", str(runs), SYSTEM])
    runpy.run_path(str(script))
    out = capsys.readouterr().out
    assert "coulomb_friction" in out.split("declared parameter")[0]
    assert Path("diagnosis/report.html").is_file()
    assert "coulomb_friction" in nsde_torch.load("model").system.effect_names


@pytest.mark.parametrize("kept", [True, False])
def test_a_training_names_a_folder_that_it_wrote_and_no_other(kept: bool, runs: Path, tmp_path: Path) -> None:
    said: list[str] = []
    folder = tmp_path / "run" if kept else None
    nsde_torch.train(runs, system=SYSTEM, model="sysid", run_dir=folder, say=said.append)
    assert said[-1].strip().startswith("took ")
    assert (f"wrote {folder}" in said[-1]) == kept == ("wrote" in said[-1])


@pytest.mark.parametrize(
    ("candidate", "why"),
    [
        ("linear_spring", "declared already"),
        ("propeller_drag", "does not list"),
        ("linear_drag", "cannot have"),
    ],
)
def test_a_candidate_that_cannot_be_one_is_refused_before_anything_is_read(candidate: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        nsde_torch.diagnose("nowhere", system=SYSTEM, candidates=[candidate])


@pytest.mark.slow
def test_a_candidate_whose_channel_is_not_logged_is_refused_before_any_work() -> None:
    def work(*step: Any) -> None:
        raise AssertionError(step)

    given: dict[str, Any] = {"system": "quadrotor", "candidates": ["battery_voltage"], "say": work}
    with pytest.raises(ConfigError, match="'battery_voltage', which 'quadrotor' cannot have"):
        nsde_torch.diagnose([leaning_flight(6.0)], **given)


def test_a_training_that_is_stopped_once_the_model_is_fitted_returns_it(
    runs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("nsde_torch.training.session.Training._test", stop)
    model = nsde_torch.train(runs, system=SYSTEM, model="sysid")
    assert model.predict(nsde_torch.read(runs, system=SYSTEM).runs[0], horizon=0.5).run == "run_0"
    assert "stopped: the model is fitted" in capsys.readouterr().out
    monkeypatch.setattr("nsde_torch.training.session.Training._fit", stop)
    with pytest.raises(KeyboardInterrupt):
        nsde_torch.train(runs, system=SYSTEM, model="sysid")
