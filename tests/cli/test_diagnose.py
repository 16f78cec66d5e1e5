"""`nsde diagnose` from the command line to files, and what `nsde train` makes of them."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from omegaconf import OmegaConf

import nsde_torch
from nsde_torch.cli import build
from nsde_torch.cli.main import main
from nsde_torch.errors import ConfigError
from nsde_torch.models import IdentifiedModel
from nsde_torch.recording import Recording
from nsde_torch.simulation import simulate
from nsde_torch.simulation.generate import write
from nsde_torch.systems.options import SystemOptions
from tests.helpers.commands import Said

pytestmark = [pytest.mark.usefixtures("elsewhere"), pytest.mark.drawn]

SYSTEM = "system=mass_spring_damper"
Diagnosed = tuple[Path, dict[str, Any]]
"""The folder of a diagnosis, and its result."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "spring"
    made = simulate(
        "mass_spring_damper",
        effects=[{"coulomb_friction": {"size": 0.3}}],
        durations=(5.0,) * 3,
        dt=0.02,
        seed=1,
    )
    write(made, folder)
    return folder


@pytest.fixture(scope="module")
def diagnosed(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Diagnosed:
    out = tmp_path_factory.mktemp("out") / "diagnosis"
    words = [SYSTEM, "data=csv", f"data.path={runs}", "retrain=false", f"out_dir={out}"]
    assert main(["diagnose", *words, "candidates=[coulomb_friction,quadratic_damping]"]) == 0
    return out, json.loads((out / "diagnosis.json").read_text())


def expanded(effects: list[str], **parameters: Any) -> SystemOptions:
    """The group `system` of a spring once the effects of files are in the place of their names."""
    return build.system_options(
        OmegaConf.create({"name": "mass_spring_damper", "effects": effects, "parameters": parameters})
    )


def test_one_command_finds_the_effect_and_writes_what_it_says(diagnosed: Diagnosed) -> None:
    out, result = diagnosed
    assert result["verdict"] == "effect_found"
    assert result["added"] == ["coulomb_friction"]
    assert {p.name for p in out.iterdir()} >= {"diagnosis.json", "report.html", "effects.yaml", "plots"}
    assert {p.name for p in (out / "plots").iterdir()} >= {"residual.png", "errors.png", "spectrum.png"}
    assert "coulomb_friction" in (out / "report.html").read_text()
    effects = yaml.safe_load((out / "effects.yaml").read_text())
    assert effects["system"] == "mass_spring_damper"
    size = result["parameters"]["coulomb_friction.size"]["value"]
    assert effects["effects"]["coulomb_friction"]["size"] == pytest.approx(size, rel=0.01)


def test_effects_yaml_gives_a_training_the_effects_and_their_values(diagnosed: Diagnosed) -> None:
    out, _ = diagnosed
    machine = expanded([str(out / "effects.yaml"), "input_delay"])
    assert machine.effects == ("coulomb_friction", "input_delay")
    assert machine.values["coulomb_friction.size"] == pytest.approx(0.3, rel=0.1)
    given = expanded([str(out / "effects.yaml")], coulomb_friction={"size": 0.7})
    assert given.values["coulomb_friction.size"] == 0.7


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("system: cartpole\neffects: {coulomb_friction: {size: 0.3}}", "cartpole"),
        ("effects: [coulomb_friction]", "NAME"),
        ("[", "YAML"),
        (None, "no file"),
    ],
)
def test_an_effects_file_that_cannot_be_used_says_why(content: str | None, message: str) -> None:
    if content is not None:
        Path("effects.yaml").write_text(content)
    with pytest.raises(ConfigError, match=message):
        expanded(["effects.yaml"])


def test_a_folder_that_holds_a_diagnosis_is_not_written_over(
    diagnosed: Diagnosed, runs: Path, refused: Said
) -> None:
    out, _ = diagnosed
    before = (out / "diagnosis.json").read_bytes()
    words = [SYSTEM, "data=csv", f"data.path={runs}", "retrain=false", f"out_dir={out}"]
    assert "name another folder" in refused("diagnose", *words)
    assert (out / "diagnosis.json").read_bytes() == before


@pytest.mark.slow
def test_a_model_is_trained_with_what_was_found_and_loads(runs: Path) -> None:
    words = [SYSTEM, "data=csv", f"data.path={runs}", "model=sysid", "out_dir=out", "data.test=[0]"]
    assert main(["diagnose", *words, "candidates=[coulomb_friction]"]) == 0
    result = json.loads(Path("out/diagnosis.json").read_text())
    assert result["data"]["runs"] == ["run_1", "run_2"]  # nothing is looked for in what is held back
    assert result["model"]["path"] == "model"
    assert result["model"]["test_runs"] == ["run_0"]
    model = nsde_torch.load(Path("out/model"))
    assert isinstance(model, IdentifiedModel)
    assert "coulomb_friction" in model.system.effect_names
    assert model.system.all_declared()["coulomb_friction.size"][0].tolist() == pytest.approx([0.3], rel=0.1)


@pytest.mark.slow
def test_an_effect_of_the_users_own_is_found_and_its_file_names_it_for_other_commands(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(root / "examples" / "extend")
    own = "detent:Detent"
    teeth = [{own: {"size": 0.3, "pitch": 0.1}}]
    write(simulate("mass_spring_damper", effects=teeth, durations=(6.0,) * 4, seed=1), "data")
    words = [SYSTEM, "data=csv", "data.path=data", "retrain=false", f"also=[{own}]", "out_dir=out"]
    assert main(["diagnose", *words]) == 0
    result = json.loads(Path("out/diagnosis.json").read_text())
    assert result["added"] == ["detent"]
    assert result["parameters"]["detent.pitch"]["value"] == pytest.approx(0.1, rel=0.02)
    machine = expanded(["out/effects.yaml"])
    assert machine.effects == (own,)
    assert machine.values["detent.size"] == pytest.approx(0.3, rel=0.1)


@pytest.mark.slow
def test_a_biased_and_late_sensor_is_put_right_in_what_the_model_is_trained_on(tmp_path: Path) -> None:
    chain = Recording(sensor_bias={"q_dot": 0.2}, sensor_delay={"q_dot": 0.06})
    made = simulate("mass_spring_damper", durations=(6.0,) * 4, seed=1, recording=chain)
    write(made, tmp_path / "data")
    few = ["trainer.steps=3", "trainer.polish=0", "trainer.calibrate=false"]
    few.append("candidates=[coulomb_friction,input_delay]")
    assert main(["diagnose", SYSTEM, "data=csv", "data.path=data", "out_dir=out", *few]) == 0
    found = json.loads((tmp_path / "out/diagnosis.json").read_text())
    assert found["added"] == ["sensor_delay", "sensor_bias"]
    data = yaml.safe_load((tmp_path / "out/model/config.yaml").read_text())["config"]["data"]
    assert data["sensor_bias"]["q_dot"] == pytest.approx(0.2, abs=0.02)
    assert data["sensor_delay"]["q_dot"] == pytest.approx(0.06, abs=0.02)


@pytest.mark.parametrize("key", ["sensor_bias", "sensor_delay", "sensor_lag"])
def test_a_fault_of_no_sensor_is_refused(key: str, runs: Path, refused: Said) -> None:
    words = ["diagnose", SYSTEM, f"data.path={runs}", "retrain=false", "out_dir=out"]
    for word, said in (("q_dt: 0.1", "q_dot"), ("q_dot: nan", "finite")):
        assert said in refused(*words, f"data.{key}={{{word}}}")
