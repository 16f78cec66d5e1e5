"""`nsde evaluate` from the command line, on tiny trainings of the spring."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from nsde_torch.cli.main import main
from tests.cli.test_train_end_to_end import FAST, folder_of_runs
from tests.cli.test_train_end_to_end import SPRING as RUNS_OF_A_SPRING
from tests.helpers.commands import Said

SPRING = (*FAST, *RUNS_OF_A_SPRING, "trainer.calibrate=false")
RED = "\033[31m"


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of runs, `nsde` and `node`, trained on two swings."""
    folder = tmp_path_factory.mktemp("evaluate")
    folder_of_runs(folder / "swings", [0, 1, 2], 0.002)
    folder_of_runs(folder / "others", [7], 0.02)
    for name, more in {"nsde": [], "node": ["model=node"]}.items():
        assert (
            main(["train", *SPRING, f"data.path={folder / 'swings'}", *more, f"run_dir={folder / name}"]) == 0
        )
    return folder


@pytest.fixture(autouse=True)
def _plain(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("NO_COLOR", "FORCE_COLOR", "NSDE_TRACEBACK"):
        monkeypatch.delenv(name, raising=False)


def evaluate(*words: str) -> dict[str, Any]:
    assert main(["evaluate", "out_dir=out", "particles=19", *words]) == 0
    content: dict[str, Any] = json.loads(Path("out/evaluation.json").read_text())
    return content


def metrics(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return content


@pytest.fixture
def refused(refused: Said) -> Said:
    def run(*words: str) -> str:
        said = refused("evaluate", *words)
        assert said.startswith("nsde evaluate: ")
        return said

    return run


def test_two_runs_are_compared_and_runs_of_training_are_red(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    both = f"run=[{here / 'nsde'},{here / 'node'}]"
    content = evaluate(both, "names=[sde,ode]", "data=csv", f"data.path={here / 'swings'}")
    assert [m["name"] for m in content["models"]] == ["sde", "ode"]
    for model in content["models"]:
        assert model["trained_on"] == {"swing_0": True, "swing_1": True, "swing_2": False}
        assert set(model["trained_on_match"].values()) == {"whole", ""}
        assert not model["held_out"]
    differences = content["differences"]
    assert differences["unit"] == "blocks of 4 s"
    assert set(differences["against"]) == {"ode", "hold", "constant_velocity"}
    for row in differences["against"]["ode"]["errors"].values():
        for d in row.values():
            assert d["low"] <= d["difference"] <= d["high"]
            assert d["verdict"] in ("better", "worse", "no difference")
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith(f"{RED}swing_0") and "TRAINED ON" in line for line in lines)
    assert any(line.startswith("swing_2") and "held out" in line for line in lines)
    assert all(line.startswith(RED) for line in lines if "sde (TRAINED ON)" in line)
    assert f"{RED}note: sde was trained on swing_0, swing_1: this is no test" in "\n".join(lines)


def test_without_colours_the_words_say_it(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("NO_COLOR", "1")
    content = evaluate(f"run={here / 'nsde'}", "data.test=[0]", "horizons=[0.2,1]")
    assert content["horizons_s"] == [0.2, 1.0]
    assert content["data"]["runs"][0]["trained_on_by"] == ["nsde"]
    said = capsys.readouterr().out
    assert RED not in said
    assert "nsde (TRAINED ON)" in said


def test_a_run_of_an_older_version_is_judged_by_names_and_says_so(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(here / "nsde", "old")
    content = metrics(Path("old"))
    for key in ("train_hashes", "train_rows", "train_sensor_std"):
        del content[key]
    Path("old/metrics.json").write_text(json.dumps(content))
    assert main(["evaluate", "run=old", "sensor_noise=data", "out_dir=no"]) == 2
    assert "does not record the sensors of its training data; take train" in capsys.readouterr().err
    made = evaluate("run=old", "data.test=[1]")
    assert made["models"][0]["trained_on_match"] == {"swing_1": "by name"}
    said = capsys.readouterr().out
    assert "trained on runs named swing_1" in " ".join(said.split())
    assert "recognised by name alone" in " ".join(said.split())


@pytest.mark.slow
def test_the_sensors_of_a_further_folder_are_those_that_a_training_assumes(here: Path) -> None:
    further = [f"data.path={here / 'swings'}", f"data.test_path={here / 'others'}"]
    assert main(["train", *SPRING, *further, "run_dir=noisy"]) == 0
    expected = metrics(Path("noisy"))["test"]
    content = evaluate("run=noisy", "particles=199")
    model = content["models"][0]
    assert model["sensor_std"] == expected["sensor_std"]
    assert model["coverage"] == expected["coverage"]
    shutil.rmtree("out")
    same = evaluate(f"run={here / 'nsde'}", f"data.test_path={here / 'others'}")["models"][0]
    assert same["sensor_std"]["q"] > 4 * metrics(here / "nsde")["sensor_std"]["q"]
    shutil.rmtree("out")
    other = evaluate("run=noisy", "sensor_noise=train")["models"][0]
    assert "sensor_std" not in other
    assert other["coverage"]["0.9"]["position"]["0.1"] < model["coverage"]["0.9"]["position"]["0.1"]


def test_data_of_the_package_are_scored_on_every_run(here: Path) -> None:
    content = evaluate(f"run={here / 'nsde'}", "data=simulated", "data.durations=[6,6]")
    assert content["data"]["kind"] == "simulated"
    assert len(content["data"]["runs"]) == 2
    assert content["models"][0]["held_out"]


def test_a_missing_unfinished_or_damaged_run_is_named(here: Path, refused: Said) -> None:
    assert "no such folder" in refused("run=nowhere")
    assert "`run` must be given" in refused()
    assert "no run directory" in refused(f"run={here / 'swings'}")
    assert "holds 2 runs" in refused(f"run={here}")
    assert "twice" in refused(f"run=[{here / 'nsde'},{here / 'nsde'}/]")
    assert "`names` must hold one name" in refused(f"run={here / 'nsde'}", "names=[a,b]")
    shutil.copytree(here / "nsde", "cut")
    Path("cut/metrics.json").write_text("{")
    assert "metrics.json is damaged" in refused("run=cut")
    Path("cut/metrics.json").unlink()
    assert "has not finished" in refused("run=cut")
    Path("flight/.hydra").mkdir(parents=True)
    Path("flight/track.log").touch()
    assert "this is no run directory" in refused("run=flight")
    Path("cut/failed.json").write_text("{}")
    assert "this training failed" in refused("run=cut")
    assert not list(Path("evaluations").rglob("evaluation.json"))


def test_runs_of_other_systems_and_data_that_do_not_fit_are_refused(here: Path, refused: Said) -> None:
    words = (*FAST, "system=cartpole", "data.durations=[3,3]", "model=sysid", "model.max_iterations=1")
    assert main(["train", *words, "run_dir=cart"]) == 0
    text = refused(f"run=[{here / 'nsde'},cart]")
    assert "of mass_spring_damper" in text
    assert "cart of cartpole" in text
    Path("bad").mkdir()
    Path("bad/a.csv").write_text("t,x,y\n" + "".join(f"{0.01 * k},0,0\n" for k in range(500)))
    assert "q" in refused(f"run={here / 'nsde'}", "data=csv", "data.path=bad")
    text = refused(f"run={here / 'nsde'}", "data=csv", f"data.path={here / 'swings'}", "data.dt=0.02")
    assert "no whole multiple of the data's 0.02 s" in text
    assert "longest stretch" in refused(f"run={here / 'nsde'}", "horizons=[30]")
    assert "x does not exist; expected a log" in refused(f"run={here / 'nsde'}", "data.path=x")
    assert "no run 9" in refused(f"run={here / 'nsde'}", "data.test=[9]")


def test_a_run_whose_data_have_moved_says_so(here: Path, refused: Said) -> None:
    shutil.copytree(here / "nsde", "moved")
    config = yaml.safe_load(Path("moved/config.yaml").read_text())
    config["config"]["data"]["path"] = "gone"
    Path("moved/config.yaml").write_text(yaml.safe_dump(config))
    assert "`data.path=gone`" in refused("run=moved")
    del config["config"]
    Path("moved/config.yaml").write_text(yaml.safe_dump(config))
    assert "does not say which data" in refused("run=moved")
    content = evaluate("run=moved", "data=csv", f"data.path={here / 'swings'}", "data.test=[2]")
    assert content["models"][0]["held_out"]


def test_an_evaluation_is_not_written_over_and_a_sweep_is_refused(here: Path, refused: Said) -> None:
    evaluate(f"run={here / 'nsde'}")
    assert "holds an evaluation already" in refused(f"run={here / 'nsde'}", "out_dir=out")
    assert "has no sweeps" in refused("-m", f"run={here / 'nsde'},{here / 'node'}")
