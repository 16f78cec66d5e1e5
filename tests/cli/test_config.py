"""Configurations compose, and a mistake in one is named in one clean message."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from nsde_torch.cli import groups, jobs
from nsde_torch.cli.commands.train import TrainConfig
from nsde_torch.cli.main import main
from nsde_torch.cli.registry import hydra_command
from nsde_torch.cli.store import store
from nsde_torch.errors import ConfigError
from tests.helpers.commands import Said

CHOICES = [(group, choice) for group in groups.defaults("train") for choice in groups.choices(group)]


BOMB = "\n".join(
    f"k{n}: &k{n} [{', '.join([f'*k{n - 1}'] * 9 if n else 'x' * 9)}]" for n in range(9)
).encode()
"""Aliases of aliases: a file of 300 bytes that represents 400 million values."""


@pytest.fixture
def hydra_ready() -> Iterator[None]:
    store(hydra_command("train"))
    with initialize_config_module("nsde_torch.conf", version_base="1.3"):
        yield


@pytest.mark.usefixtures("hydra_ready")
@pytest.mark.parametrize(("group", "choice"), CHOICES)
def test_every_choice_of_every_group_composes_and_passes_its_checks(group: str, choice: str) -> None:
    words = [f"{group}={choice}", "run_dir=r", "sweep_dir=s"]
    if "path" in [
        entry.path.split(".")[-1] for entry in groups.keys("train", groups.selected("train", words))
    ]:
        words.append("data.path=somewhere")
    if choice == "own":
        words.append(f"{group}.kind=my_module:Mine")
    config = compose("train", overrides=words)
    jobs.check_config(config, "train", words)
    assert OmegaConf.get_type(config) is TrainConfig


@pytest.mark.usefixtures("hydra_ready")
def test_help_and_hydra_agree_on_every_default() -> None:
    config: Any = compose("train", overrides=["run_dir=r", "sweep_dir=s"])
    for entry in groups.keys("train", groups.defaults("train")):
        if entry.path not in ("run_dir", "sweep_dir"):
            assert OmegaConf.select(config, entry.path) == entry.default, entry.path


def test_solver_choices_are_the_steps_of_the_library() -> None:
    from nsde_torch.sde.registry import STEPS

    assert set(groups.choices("solver")) == {"default", *STEPS}


def test_system_choices_are_the_systems_of_the_library() -> None:
    from nsde_torch.systems import SYSTEMS

    assert set(groups.choices("system")) == set(SYSTEMS)


@pytest.mark.usefixtures("hydra_ready")
@pytest.mark.parametrize("name", groups.choices("system"))
def test_every_system_is_built_from_its_configuration(name: str) -> None:
    from nsde_torch.cli import build
    from nsde_torch.models.kind import Choice, model_kind, model_options

    config = compose("train", overrides=[f"system={name}"])
    system = build.system(config.system)
    assert system.name == name
    choice = Choice(
        options=model_options("nsde"),
        system=build.system_options(config.system),
        machine=system,
        runs=(),
        loss="replay",
        integrator=build.integrator(config.solver),
    )
    assert model_kind("nsde").step(choice).name == system.defaults.step


@pytest.mark.usefixtures("hydra_ready")
def test_parameters_of_effects_are_reached_with_dots() -> None:
    from nsde_torch.cli import build

    words = ["system=hexacopter", "system.effects=[linear_drag]", "++system.parameters.linear_drag.wrong=0.2"]
    with pytest.raises(ConfigError, match="wrong"):
        build.system(compose("train", overrides=words).system)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["trainer.stps=3"], "`trainer.stps` is not a key of `nsde train`. Did you mean `trainer.steps`?"),
        (["sytem=cartpole"], "`sytem` is not a key of `nsde train`. Did you mean `system`?"),
        (["+trainer.stps=3"], "Did you mean `trainer.steps`?"),
        (["lr=0.1"], "Did you mean `trainer.lr`?"),
        (["system=cartpol"], "Did you mean `system=cartpole`?"),
        (
            ["data=/logs/monday"],
            "`data=/logs/monday`: `data` is a kind of data, and a path goes into `data.path`",
        ),
        (["data=logs/monday"], "a path goes into `data.path`: data.path=logs/monday"),
        (["data=ünï (1)"], "a path goes into `data.path`: 'data.path=ünï (1)'"),
        (["logs (1)"], "`logs (1)` is not KEY=VALUE. A path goes into `data.path`: 'data.path=logs (1)'."),
        (["data.path", "logs"], "`data.path` has no value: write data.path=VALUE"),
        (["loss=my/own"], "`loss=my/own`: no such choice."),
        (["hydra/launcher=joblob"], "`hydra/launcher=joblob`: no such choice."),
        (
            ["data=simulated", "data.path=x"],
            "`data.path` is a key of data=csv or data=ulog or data=published",
        ),
        (["data=csv"], "`data.path` must be given: file or folder to read. Add data.path=..."),
        (
            ["data=csv", "data.durations=[1]"],
            "`data.durations` is a key of data=simulated, but data=csv is chosen.",
        ),
        (["trainer.steps=many"], "`trainer.steps` must be a whole number; got 'many'."),
        (["system.dt=0.1s"], "`system.dt` must be a number, without its unit; got '0.1s'."),
        (["data.path=nowhere"], "`data.path`: nowhere does not exist; expected a log or a folder of logs."),
        (["data.path="], "`data.path` is empty"),
        (["data.path=null"], "`data.path` must be given; it cannot be null."),
        (["seed=ü"], "`seed=ü` is not in Hydra's grammar."),
        (["hydra.output_subdir=../../x"], "`hydra.output_subdir` must be a name in the folder of the run"),
        (["+hydra.output_subdir=/tmp/x"], "`hydra.output_subdir` must be a name in the folder of the run"),
        (["hydra={output_subdir: ../../x}"], "`hydra` is set key by key: hydra.KEY=VALUE"),
        (["++hydra.sweep={subdir: ../x}"], "`hydra.sweep` is set key by key"),
        (["hydra.job.name='../x'"], "`hydra.job.name` must be a name in the folder of the run"),
        (["hydra.run.dir=/tmp/x"], "`hydra.run.dir` is set by the command: name the folder with run_dir"),
        (
            ["-m", "hydra.sweep.dir=x"],
            "`hydra.sweep.dir` is set by the command: name the folder with sweep_dir",
        ),
        (["-m", "hydra.sweep.subdir=../x"], "`hydra.sweep.subdir` must be a name in the folder of the run"),
        (
            ["data=own", "data.kind=os:system", "data.path=x"],
            "A reader is a function `read(system, *, path, ...)`.",
        ),
        (["data=own", "data.kind=builtins:max", "data.path=x"], "A reader is a function"),
        (["data=own", "data.kind=:read", "data.path=x"], "expected `module:function`"),
        (["run_dir=/dev/null/x"], "/dev/null/x: Not a directory. Name another folder or file."),
        ([f"run_dir={'x' * 300}"], "File name too long. Name another folder or file."),
        (["trainer.steps=-1"], "`trainer.steps` must be at least 1; got -1."),
        (["dtype=float16"], "`dtype` must be float32 | float64; got 'float16'."),
        (["data.test=1"], "A list needs brackets: 'data.test=[...]'."),
        (["seed=0,1"], "To sweep over it, add --multirun"),
        (["data=csv", "data.path=nowhere"], "`data.path`: nowhere does not exist"),
        (["system=[a"], "`system=[a` is not in Hydra's grammar."),
        (["--config-dir", "nowhere"], "`--config-dir nowhere`: no such folder."),
        (["resume=nowhere"], "there is no run to continue"),
        (["seed=99999999999999999999"], "`seed` must have fewer than 19 digits"),
        (["run_dir="], "`run_dir` is empty; name a folder."),
        (["=1"], "`=1` is not KEY=VALUE"),
        (["~seed"], "no key can be taken out of the configuration"),
        (["-m", "run_dir=a"], "a sweep takes `sweep_dir=...`"),
        (["-m", "resume=a"], "`resume` continues one run; leave out -m."),
    ],
)
def test_a_mistake_is_one_clean_message(
    words: list[str],
    expected: str,
    refused: Said,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("NSDE_TRACEBACK", raising=False)
    err = refused("train", *words)
    assert expected in err
    assert err.startswith("nsde train: ")
    assert "Traceback" not in err
    assert "https://" not in err


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"name: !!python/object/apply:os.system ['touch hacked']\n", "mine.yaml, line 1: no plain YAML"),
        (b"name: [unclosed\n", "mine.yaml, line 2: no plain YAML"),
        (b"\xff\xfe", "mine.yaml is no UTF-8 text"),
        (b"- 1\n", "mine.yaml must hold `KEY: VALUE` lines; got list"),
        (BOMB, "mine.yaml: its aliases represent more than a million values"),
        (b"a: &a [*a]\n", "mine.yaml: no plain YAML (it refers to itself"),
        (b"[" * 9999, "mine.yaml: no plain YAML (it refers to itself, or is nested too deeply"),
    ],
)
@pytest.mark.parametrize("command", ["train", "effects"])
def test_a_file_of_ones_own_that_is_no_plain_yaml_is_named(
    command: str, content: bytes, expected: str, tmp_path: Path, refused: Said
) -> None:
    (tmp_path / "system").mkdir()
    (tmp_path / "system" / "mine.yaml").write_bytes(content)
    said = refused(command, "--config-dir", str(tmp_path), "system=mine")
    assert expected in said
    assert len(said.splitlines()) == 1
    assert not (tmp_path / "hacked").exists()


def test_a_file_of_ones_own_that_includes_itself_is_said(tmp_path: Path, refused: Said) -> None:
    (tmp_path / "system").mkdir()
    (tmp_path / "system" / "mine.yaml").write_text("defaults: [mine, _self_]\n")
    assert "includes itself (`defaults`)" in refused("train", "--config-dir", str(tmp_path), "system=mine")


@pytest.mark.parametrize("record", ["a: b", "!!python/object/apply:os.system ['touch hacked']", "[", "3"])
def test_a_damaged_record_of_the_command_is_said_where_it_is_resumed(
    record: str, tmp_path: Path, refused: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run" / ".hydra").mkdir(parents=True)
    for name in ("overrides.yaml", "hydra.yaml"):
        (tmp_path / "run" / ".hydra" / name).write_text(record)
    assert "`resume=run`: the record of its command in run/.hydra is damaged" in refused(
        "train", "resume=run"
    )
    assert not (tmp_path / "hacked").exists()


def test_an_effect_of_ones_own_that_is_none_is_refused_before_data_are_read(
    refused: Said, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert "effect 'os:system' must be a subclass" in refused(
        "diagnose", "system=mass_spring_damper", "data.path=nowhere", "also=[os:system]"
    )


@pytest.mark.parametrize("value", ["abc", "[1, [2]]", "2024-01-01", "{a: 1}", "yes"])
def test_text_as_a_value_in_an_effects_file_is_refused(
    value: str, tmp_path: Path, refused: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "effects.yaml").write_text(f"effects: {{coulomb_friction: {{size: {value}}}}}\n")
    said = refused("diagnose", "system=mass_spring_damper", "system.effects=effects.yaml")
    assert "size" in said
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ("track", "it has to be a multirotor (hexacopter, quadrotor)"),
        ("export", "it has to be a multirotor (hexacopter, quadrotor)"),
        ("design", "The system is that of the model, run=DIR. Its groups: none."),
    ],
)
def test_a_system_is_not_chosen_where_a_model_has_one(command: str, expected: str, refused: Said) -> None:
    err = refused(command, "system=mass_spring_damper")
    assert f"`system` is not a group of `nsde {command}`. " in err
    assert expected in err


def test_traceback_is_shown_on_request(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NSDE_TRACEBACK", "1")
    assert main(["train", "trainer.steps=-1"]) == 2
    assert "Traceback" in capsys.readouterr().err


def test_open_dicts_take_new_keys_without_a_plus(shown: Said) -> None:
    assert "mass: 2.5" in shown("train", "--cfg", "job", "system.parameters.mass=2.5")


def test_own_config_folder_adds_a_choice_that_is_checked_like_the_others(
    tmp_path: Path, refused: Said, shown: Said
) -> None:
    (tmp_path / "system").mkdir()
    (tmp_path / "system" / "mine.yaml").write_text("name: my_module:Pendulum\ndt: 0.02\n")
    assert "name: my_module:Pendulum" in shown(
        "train", "--config-dir", str(tmp_path), "--cfg", "job", "system=mine"
    )
    assert "name: my_module:Pendulum" in shown(
        "train", "seed=1", "--config-dir", str(tmp_path), "system=mine", "--cfg", "job"
    )
    (tmp_path / "system" / "wrong.yaml").write_text("nme: my_module:Pendulum\n")
    assert "In system/wrong.yaml: `system.nme` is not a key" in refused(
        "train", "--config-dir", str(tmp_path), "system=wrong"
    )
    (tmp_path / "system" / "typed.yaml").write_text("name: my_module:Pendulum\nhorizon: long\n")
    assert "In system/typed.yaml: `system.horizon` must be a whole number; got 'long'" in refused(
        "train", "--config-dir", str(tmp_path), "system=typed"
    )


def test_own_data_file_builds_on_one_of_the_packages(tmp_path: Path, refused: Said, shown: Said) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "field.yaml").write_text("defaults: [csv, _self_]\npath: flights\ntest: [0]\n")
    assert "path: flights" in shown("train", "--config-dir", str(tmp_path), "--cfg", "job", "data=field")
    (tmp_path / "data" / "bare.yaml").write_text("kind: csv\npath: flights\n")
    assert "defaults: [CHOICE, _self_]" in refused("train", "--config-dir", str(tmp_path), "data=bare")


def test_search_path_reaches_a_folder_given_by_hydra(tmp_path: Path, shown: Said) -> None:
    (tmp_path / "trainer").mkdir()
    (tmp_path / "trainer" / "long.yaml").write_text("steps: 123456\n")
    words = ["--cfg", "job", f"hydra.searchpath=[file://{tmp_path}]", "trainer=long"]
    assert "steps: 123456" in shown("train", *words)
