"""The files of examples/extend do what the pages of how-to/extend say: each extension is one file, used end to end."""

import json
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import nsde_torch
from nsde_torch.cli.commands.completion import query
from nsde_torch.cli.main import main
from nsde_torch.data import DataSet
from nsde_torch.errors import ConfigError
from nsde_torch.models import Model
from nsde_torch.sde import make_step, rollout
from nsde_torch.simulation import Simulation
from nsde_torch.systems import System, make_system
from tests.helpers.effect_contract import EffectContract
from tests.helpers.model_contract import ModelContract
from tests.helpers.sde_problems import Quiet
from tests.helpers.system_contract import SystemContract

EXAMPLES = Path(__file__).resolve().parents[1] / "examples" / "extend"
RAIL, DETENT = "rail:Rail", "detent:Detent"


@pytest.fixture(scope="module", autouse=True)
def _importable() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        yield


@pytest.fixture(scope="module")
def runs() -> Simulation:
    return nsde_torch.simulate(RAIL, durations=[8.0] * 3, seed=1)


# ---- a system --------------------------------------------------------------------------------------------------------


class TestRail(SystemContract):
    def make(self, **options: Any) -> System:
        return make_system(RAIL, **options)

    def test_it_obeys_its_equation(self) -> None:
        s = self.make(values={"gain": 2.0, "viscous_friction.damping": 0.5})
        rate = s.drift(0.0, torch.tensor([[1.0, 3.0]]), torch.tensor([[4.0]])).detach()
        torch.testing.assert_close(rate, torch.tensor([[3.0, 2.0 * 4.0 - 0.5 * 3.0]]))


def test_a_system_is_simulated_as_it_says(runs: Simulation) -> None:
    from rail import Rail

    assert [len(run.t) for run in runs.runs] == [801] * 3
    assert runs.truth["effects"]["coulomb_friction"]["standing"]
    volts = np.concatenate([run.u for run in runs.runs])
    assert 0.5 < volts.std() < 3.0
    again = nsde_torch.simulate(Rail, durations=[8.0] * 3, seed=1)
    assert all((a.x == b.x).all() for a, b in zip(runs.runs, again.runs, strict=True))
    quiet = nsde_torch.simulate(Rail, durations=[2.0], seed=1, options={"size": 0.1})
    assert quiet.runs[0].u.std() < 0.5


def test_a_system_without_a_machine_is_not_simulated() -> None:
    with pytest.raises(ConfigError, match=r"says no `machine`.*write `machine = Machine"):
        nsde_torch.simulate("tests.helpers.rate_loops:RateLoop", seed=0)


# ---- a reader --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def logs(runs: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    for run in runs.runs:
        rows = zip((1e6 * run.t).round(), 1e3 * run.x, 1e3 * run.u, strict=True)
        names = ("time_us", "position_mm", "speed_mm_s", "motor_mv")
        text = "".join(json.dumps(dict(zip(names, (t, *x, *u), strict=True))) + "\n" for t, x, u in rows)
        (folder / f"{run.name}.jsonl").write_text(text, encoding="utf-8")
    return folder


def test_a_reader_makes_a_data_set(runs: Simulation, logs: Path) -> None:
    from json_lines import read_json_lines

    data = nsde_torch.read(logs, system=RAIL, kind="json_lines:read_json_lines")
    assert isinstance(data, DataSet)
    assert data.names == ("run_0", "run_1", "run_2")
    assert data.dt == pytest.approx(0.01)
    np.testing.assert_allclose(data.runs[1].x, runs.runs[1].x, atol=1e-9)
    np.testing.assert_allclose(data.runs[1].u, runs.runs[1].u, atol=1e-9)
    one = nsde_torch.read(logs, system=RAIL, kind=read_json_lines, options={"pattern": "run_2.jsonl"})
    assert one.names == ("run_2",)


def test_a_reader_that_does_not_fit_is_refused(logs: Path) -> None:
    with pytest.raises(ConfigError, match="has no function 'nothing'"):
        nsde_torch.read(logs, system=RAIL, kind="json_lines:nothing")
    with pytest.raises(ConfigError, match="unexpected keyword argument 'patern'"):
        nsde_torch.read(logs, system=RAIL, kind="json_lines:read_json_lines", options={"patern": "*"})


def test_the_command_line_takes_a_system_a_reader_and_a_kind_of_model(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["--config-dir", str(EXAMPLES), f"system.name={RAIL}"]
    data = ["data=own", "data.kind=json_lines:read_json_lines", f"data.path={logs}"]
    model = ["model=own", "model.kind=linear_model:Linear", "model.options.ridge=0.01"]
    assert main(["train", *words, *data, *model, "data.options.pattern=*.jsonl", "run_dir=run"]) == 0
    trained = nsde_torch.load("run")
    assert (trained.spec.kind, trained.spec.system) == ("linear_model:Linear", RAIL)
    assert trained.spec.as_dict()["ridge"] == 0.01
    assert trained.metrics["test"]["errors"]["model"]["position"]["0.5"] < 0.1
    assert main(["simulate", *words, "durations=[2]", "out=made"]) == 0
    assert (tmp_path / "made" / "run_0.csv").read_text().startswith("t,p,p_dot,voltage\n")


# ---- an effect -------------------------------------------------------------------------------------------------------


class TestDetent(EffectContract):
    name = DETENT
    system = RAIL
    values = {"size": 0.5, "pitch": 0.3}

    def test_it_moves_the_velocity_alone(self) -> None:
        x = torch.tensor([[0.0125, 2.0]])
        rate = self.make({"size": 0.5, "pitch": 0.05})(0.0, x, torch.zeros(1, 1), torch.zeros(1, 0)).detach()
        torch.testing.assert_close(rate, torch.tensor([[0.0, -0.5]]))


@pytest.fixture(scope="module")
def held() -> Simulation:
    """Runs of a carriage that is held at every 0.05 m."""
    teeth = [{DETENT: {"size": 0.8, "pitch": 0.05}}]
    return nsde_torch.simulate(RAIL, effects=teeth, durations=[8.0] * 3, seed=2)


def test_an_effect_is_fitted_where_it_is_declared(held: Simulation, tmp_path: Path) -> None:
    effects = ["coulomb_friction", {DETENT: {"size": 0.3, "pitch": 0.05}}]
    how = {"solver": "ralston:Ralston", "run_dir": tmp_path, "say": False}
    model = nsde_torch.train(held, system=RAIL, model="sysid", effects=effects, **how)
    fitted = {name: p["value"][0] for name, p in model.metrics["parameters"].items()}
    assert fitted["detent.size"] == pytest.approx(0.8, rel=0.1)
    assert fitted["detent.pitch"] == pytest.approx(0.05, rel=0.01)
    loaded = nsde_torch.load(tmp_path)
    assert loaded.system.effect_names == ("viscous_friction", "coulomb_friction", "detent")
    assert repr(loaded.step) == "Ralston()"


# ---- a kind of model -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def linear(runs: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Model:
    folder = tmp_path_factory.mktemp("linear")
    return nsde_torch.train(
        runs, system=RAIL, model="linear_model:Linear", run_dir=folder, say=False, validation=0.1
    )


class TestLinearModel(ModelContract):
    @pytest.fixture
    def trained(self, linear: Model) -> Model:
        return linear

    def test_it_learns_the_linear_part_of_the_machine(self, trained: Model) -> None:
        weights, dt = trained.weights, trained.spec.dt  # of p, p_dot, voltage and one
        assert isinstance(weights, Tensor)
        assert float(weights[1, 0]) == pytest.approx(dt, rel=0.1)
        assert float(weights[2, 1]) == pytest.approx(2.0 * dt, rel=0.2)

    def test_it_is_evaluated_beside_another(self, trained: Model, runs: Simulation) -> None:
        physics = nsde_torch.train(runs, system=RAIL, model="sysid", say=False)
        scores = nsde_torch.evaluate({"linear": trained, "physics": physics}, runs, runs=[2], particles=20)
        assert scores.errors["position"]["0.5"] < 0.1
        assert [m["name"] for m in scores.content["models"]] == ["linear", "physics"]


def test_no_part_of_the_package_asks_for_the_class_of_a_model(root: Path) -> None:
    asked = re.compile(r"isinstance\([^()]*\b(NeuralSDE|GaussianEnsemble|IdentifiedModel)\b")
    files = [*(root / "nsde_torch").rglob("*.py"), *(root / "cli").rglob("*.py")]
    wrong = [str(f) for f in files if f.parent.name != "models" and asked.search(f.read_text("utf-8"))]
    assert len(files) > 250
    assert not wrong


# ---- a solver --------------------------------------------------------------------------------------------------------


class Swing(Quiet):
    def drift(self, t: Any, z: Tensor, u: Tensor) -> Tensor:
        return torch.cat((z[:, 1:], -torch.sin(z[:, :1])), 1)


def test_a_solver_has_the_order_it_states_and_the_limit_of_another() -> None:
    step = make_step("ralston:Ralston")
    start = torch.tensor([[1.0, 0.5]], dtype=torch.float64)

    def end(name: str, n: int) -> Tensor:
        u = torch.zeros(1, n, 1, dtype=torch.float64)
        return rollout(Swing(), start, u, dt=2.0 / n, step=make_step(name), noise=None)[0, 0, -1]

    exact = end("rk4", 2000)
    errors = [float((end("ralston:Ralston", n) - exact).norm()) for n in (20, 40, 80)]
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    np.testing.assert_allclose(orders, step.strong_order, atol=0.15)


def test_what_is_no_solver_is_refused() -> None:
    with pytest.raises(ConfigError, match="no module 'nowhere'"):
        make_step("nowhere:Step")
    with pytest.raises(ConfigError, match=r"must be a subclass of nsde_torch\.sde\.Step"):
        make_step("rail:Rail")


# ---- a command -------------------------------------------------------------------------------------------------------


def install(folder: Path, module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package of one's own that is installed and has a command in a module."""
    about = folder / "my_package-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: my_package\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[nsde_torch.commands]\nrows = {module}\n")
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, module, raising=False)


def test_a_command_of_another_package_is_listed_and_runs(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy(EXAMPLES / "rows.py", tmp_path / "rows_of_a_package.py")
    install(tmp_path, "rows_of_a_package", monkeypatch)
    monkeypatch.chdir(tmp_path)
    assert main(["--help"]) == 0
    line = "rows          How many rows each run of a data set has, and for how long it lasts"
    assert line in capsys.readouterr().out
    assert query(["row"]) == ["rows"]
    assert query(["rows", "lea"]) == ["least="]
    assert query(["rows", "system=cart"]) == ["system=cartpole"]
    assert main(["rows", "--help"]) == 0
    assert "leave out runs with fewer rows" in capsys.readouterr().out
    assert main(["rows", "system=mass_spring_damper", "data.durations=[2,3]", "least=250"]) == 0
    assert capsys.readouterr().out == "run_1: 301 rows, 3.0 s\n"
    for word, said in (
        ("laest=1", "Did you mean `least`?"),
        ("least=-1", "`least` must be at least 0"),
        ("system=cartpol", "Did you mean `system=cartpole`?"),
        ("-m", "has no sweeps"),
    ):
        assert main(["rows", word]) == 2
        assert said in capsys.readouterr().err


# ---- the pages -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.py")), ids=lambda file: file.stem)
def test_a_page_shows_every_file(file: Path, root: Path) -> None:
    pages = sorted((root / "docs" / "content" / "how-to" / "extend").glob("*.md"))
    shown = [page for page in pages if f'--8<-- "examples/extend/{file.name}"' in page.read_text()]
    assert len(shown) == 1
