"""The functions of `nsde_torch` do what the commands do; what a notebook shows, and what packages say is public."""

import ast
import doctest
import json
import runpy
import sys
from importlib import import_module
from pathlib import Path
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import nsde_torch
from nsde_torch.cli.main import main
from nsde_torch.data import DataSet, RawRun
from nsde_torch.errors import ConfigError, DataError, ShapeError
from nsde_torch.evaluation.comparison import Comparison
from nsde_torch.models import Model, SDESpec, make_model
from nsde_torch.systems import MassSpringDamper
from nsde_torch.training import TrainerOptions, options

SYSTEM = "mass_spring_damper"
QUICK = {"steps": 3, "polish": 1, "validate_every": 2, "batch": 16, "compile": "off", "calibrate": False}


def silent(text: str) -> None:
    return None


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("api") / "spring"
    dry: Any = [{"coulomb_friction": {"size": 0.3}}]
    nsde_torch.simulate(SYSTEM, effects=dry, durations=[5.0] * 3, seed=1).save(folder)
    return folder


@pytest.mark.parametrize(
    "name", [pytest.param("diagnose", marks=pytest.mark.slow), "evaluate", "read", "simulate", "train"]
)
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


def test_a_training_that_is_stopped_once_the_model_is_fitted_returns_it(
    runs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("nsde_torch.training.session.Training._test", stop)
    model = nsde_torch.train(runs, system=SYSTEM, model="sysid")
    assert model.predict(nsde_torch.read(runs, system=SYSTEM).runs[0], horizon=0.5).run == "run_0"
    assert "stopped: the model is fitted" in capsys.readouterr().out
    monkeypatch.setattr("nsde_torch.training.fit_sysid.fit_sysid", stop)
    with pytest.raises(KeyboardInterrupt):
        nsde_torch.train(runs, system=SYSTEM, model="sysid")


ROOT = Path(__file__).resolve().parents[2]
FILES = sorted((ROOT / "nsde_torch").rglob("__init__.py"))
PACKAGES = [".".join(file.parent.relative_to(ROOT).parts) for file in FILES]


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_says_what_is_public_and_has_it(package: str) -> None:
    module = import_module(package)
    assert module.__doc__
    assert len(set(module.__all__)) == len(module.__all__)
    for name in module.__all__:
        found = getattr(module, name)
        assert not isinstance(found, type | FunctionType) or found.__doc__, name


@pytest.mark.parametrize("package", PACKAGES)
def test_type_checkers_are_told_the_names_that_are_resolved(package: str) -> None:
    folder = ROOT.joinpath(*package.split("."))
    tree = ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))
    told = {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("nsde_torch.")
        for alias in node.names
        if alias.name not in ("names", "resolver")
    }
    public = set(import_module(package).__all__) - {"__version__"}
    assert told == public
    if hasattr(import_module(package), "__getattr__"):  # else imported as a whole: the name has the last word
        assert not public & {path.stem for path in folder.iterdir()}


@pytest.fixture(scope="module")
def data() -> DataSet:
    made = nsde_torch.simulate("mass_spring_damper", durations=[5.0] * 3, seed=1)
    return nsde_torch.read(made, system="mass_spring_damper")


@pytest.fixture(scope="module")
def model(data: DataSet) -> Model:
    return nsde_torch.train(data, system="mass_spring_damper", model="sysid", say=False)


@pytest.fixture(scope="module")
def scores(data: DataSet, model: Model) -> Comparison:
    return nsde_torch.evaluate({"fitted": model}, data, runs=[2], particles=2, bootstrap=100, say=False)


@pytest.fixture
def pandas(monkeypatch: pytest.MonkeyPatch) -> None:
    """A package of that name whose frame is a dict of columns."""

    def frame(values: Any, columns: Any = None) -> dict[str, list[Any]]:
        named = () if columns is None else enumerate(columns)
        return dict(values) if columns is None else {name: [row[k] for row in values] for k, name in named}

    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=frame))  # type: ignore[arg-type]


def test_each_has_a_line_and_a_page_of_its_own(data: DataSet, model: Model, scores: Comparison) -> None:
    assert repr(model) == "<Model sysid of mass_spring_damper: 3 parameters, steps of 0.01 s>"
    assert "linear_spring.stiffness = " in model._repr_html_()
    assert repr(scores).startswith("<Comparison of fitted on mass_spring_damper: ")
    assert "rms error, inputs replayed" in scores._repr_html_()
    assert data._repr_html_().startswith("<pre>data: ")
    assert "found: nothing amiss" in data._repr_html_()
    assert repr(data) == "<DataSet of mass_spring_damper: 3 runs, 15.0 s at 100 Hz>"
    assert repr(data.runs[1]) == "<Run 'run_1': 501 rows, 5 s>"
    found = model.predict(data[2], horizon=0.5)
    assert repr(found) == "<RunPrediction of 'run_2': 10 starts, 0.5 s each, 90 % intervals>"
    assert "no intervals, as the model has no noise" in found._repr_html_()
    assert found.coverage is None


@pytest.mark.usefixtures("pandas")
def test_tables_hold_what_was_found(data: DataSet, model: Model, scores: Comparison) -> None:
    rows = data.to_frame()
    assert list(rows) == ["run", "t", "q", "q_dot", "force"]
    np.testing.assert_array_equal(rows["q"], np.concatenate([run.x[:, 0] for run in data]))
    assert (rows["run"][0], rows["run"][-1]) == ("run_0", "run_2")
    parameters = model.to_frame()
    values = dict(zip(parameters["name"], parameters["value"], strict=True))
    assert values["force_gain"] == pytest.approx(1, abs=0.1)
    errors = scores.to_frame()
    at = list(zip(errors["group"], errors["horizon"], strict=True)).index(("position", 0.5))
    assert errors["error"][at] == scores.errors["position"]["0.5"]
    assert errors["unit"][at] == "m"
    found = nsde_torch.diagnose(data, system="mass_spring_damper", candidates=[], say=False).to_frame()
    assert list(found) == ["name", "value", "low", "high", "unit"]
    predicted = list(model.predict(data[0], horizon=0.5).to_frame())
    assert predicted[:6] == ["t", "ahead", "q", "q_low", "q_median", "q_high"]


def test_a_prediction_begins_at_what_was_measured_and_its_intervals_hold_their_share(data: DataSet) -> None:
    spec = SDESpec("mass_spring_damper", dt=0.02, horizon=10, step="euler_maruyama", sigma_max=(0.0, 0.3))
    model = make_model(spec, generator=torch.Generator().manual_seed(0))
    found = model.predict(data[1], horizon=0.5, level=0.8, seed=3)
    first = found.ahead == 0
    assert first.sum() == 10
    np.testing.assert_allclose(found.t[first], data[1].t[0] + 0.5 * np.arange(10), atol=1e-9)
    np.testing.assert_allclose(found.median[first], data[1].x[::50][:10], atol=1e-6)
    assert bool((found.low <= found.median).all() and (found.median <= found.high).all())
    narrow = model.predict(data[1], horizon=0.5, level=0.2, seed=3)
    assert narrow.coverage is not None
    assert found.coverage is not None
    assert narrow.coverage["q_dot"] < found.coverage["q_dot"]
    same = model.predict(data[1], horizon=0.5, level=0.8, seed=3)
    np.testing.assert_array_equal(same.low, found.low)
    figure = found.plot()
    assert [axes.get_ylabel() for axes in figure.axes] == ["q [m]", "q_dot [m/s]"]
    assert "80 % predicted" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_what_cannot_be_predicted_is_refused_by_its_name(data: DataSet, model: Model) -> None:
    for given, error, message in (
        ({"horizon": 0.001}, ConfigError, "`horizon` must be at least the model's step of 0.01 s"),
        ({"horizon": 1.0, "level": 90}, ConfigError, "`level` must lie between 0 and 1; got 90"),
        (
            {"horizon": 1.0, "inputs": "given"},
            ConfigError,
            "`inputs` must be logged, replayed or set; got 'given'",
        ),
        ({"horizon": 99.0}, DataError, "no segment is as long as a window"),
    ):
        with pytest.raises(error, match=message):
            model.predict(data[0], **given)
    with pytest.raises(ConfigError, match="`run` must be one run of a data set"):
        model.predict(data, horizon=1.0)  # type: ignore[arg-type]
    cart = nsde_torch.simulate("cartpole", durations=[3.0], seed=1)
    with pytest.raises(ShapeError, match="`run` must be of the model's system, 'mass_spring_damper'"):
        model.predict(nsde_torch.read(cart, system="cartpole")[0], horizon=0.5)
