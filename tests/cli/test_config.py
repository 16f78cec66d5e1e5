"""Schemas say what every key means; configurations compose, with files of the user's own as choices."""

import inspect
from pathlib import Path
from typing import Any

import pytest

import nsde_torch
from nsde_torch import conf, simulation
from nsde_torch.cli import groups
from nsde_torch.cli.keys import check, walk
from nsde_torch.cli.main import main
from nsde_torch.cli.registry import hydra_commands
from nsde_torch.cli.schemas import CHOICES
from nsde_torch.sde.registry import STEPS
from nsde_torch.systems import SYSTEMS
from tests.helpers.commands import Said

BOMB = "\n".join(
    f"k{n}: &k{n} [{', '.join([f'*k{n - 1}'] * 9 if n else 'x' * 9)}]" for n in range(9)
).encode()
"""Aliases of aliases: a file of 300 bytes that represents 400 million values."""


def test_choices_of_systems_and_solvers_are_those_of_the_library() -> None:
    assert set(groups.choices("system")) == set(SYSTEMS)
    assert set(groups.choices("solver")) == {"default", *STEPS}


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"name: !!python/object/apply:os.system ['touch hacked']\n", "mine.yaml, line 1: no plain YAML"),
        (b"name: [unclosed\n", "mine.yaml, line 2: no plain YAML"),
        (b"\xff\xfe", "mine.yaml is no UTF-8 text"),
        (b"- 1\n", "mine.yaml must hold `KEY: VALUE` lines; got list"),
        (BOMB, "mine.yaml: its aliases represent more than a million values"),
        (b"a: &a [*a]\n", "mine.yaml: no plain YAML (it refers to itself"),
        (b"[" * 900, "mine.yaml: no plain YAML (it refers to itself, or is nested too deeply"),
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


@pytest.mark.parametrize("value", ["abc", "[1, [2]]", "2024-01-01", "{a: 1}", "yes"])
def test_text_as_a_value_in_an_effects_file_is_refused(
    value: str, tmp_path: Path, refused: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "effects.yaml").write_text(f"effects: {{coulomb_friction: {{size: {value}}}}}\n")
    said = refused("diagnose", "system=mass_spring_damper", "system.effects=effects.yaml")
    assert "size" in said
    assert "Traceback" not in said


def test_traceback_is_shown_on_request(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NSDE_TRACEBACK", "1")
    assert main(["train", "trainer.steps=-1"]) == 2
    assert "Traceback" in capsys.readouterr().err


def test_own_config_folder_adds_choices_that_are_checked_like_the_others(
    tmp_path: Path, refused: Said, shown: Said
) -> None:
    for place, content in {
        "system/mine": "name: my_module:Pendulum\ndt: 0.02\n",
        "system/wrong": "nme: my_module:Pendulum\n",
        "system/typed": "name: my_module:Pendulum\nhorizon: long\n",
        "data/field": "defaults: [csv, _self_]\npath: flights\ntest: [0]\n",
        "data/bare": "kind: csv\npath: flights\n",
        "system/loop": "defaults: [loop, _self_]\n",
    }.items():
        (tmp_path / place).parent.mkdir(exist_ok=True)
        (tmp_path / f"{place}.yaml").write_text(content)
    own, job = ["--config-dir", str(tmp_path)], ["--cfg", "job"]
    for words in ([*own, *job, "system=mine"], ["seed=1", *own, "system=mine", *job]):
        assert "name: my_module:Pendulum" in shown("train", *words)
    assert "path: flights" in shown("train", *own, *job, "data=field")
    for word, said in {
        "system=wrong": "In system/wrong.yaml: `system.nme` is not a key",
        "system=typed": "In system/typed.yaml: `system.horizon` must be a whole number; got 'long'",
        "data=bare": "defaults: [CHOICE, _self_]",
        "system=loop": "includes itself (`defaults`)",
    }.items():
        assert said in refused("train", *own, word)


SCHEMAS = {name: command.schema for name, command in hydra_commands().items()}
ALL_SCHEMAS = [*SCHEMAS.values()] + [choice for choices in CHOICES.values() for choice in choices.values()]


@pytest.mark.parametrize("declared", ALL_SCHEMAS, ids=lambda cls: cls.__name__)
def test_every_key_has_help_in_plain_words_and_a_default_that_is_allowed(declared: type) -> None:
    keys = list(walk(declared))
    assert not [entry.path for entry in keys if not entry.help or entry.help.endswith(".")]
    own = {entry.path: entry.default for entry in keys if "." not in entry.path}
    check(declared, {name: value for name, value in own.items() if value != "???"})


@pytest.mark.parametrize("command", SCHEMAS)
def test_no_plain_key_bears_the_name_of_a_group(command: str) -> None:
    # Hydra takes `name=value` for a choice of the group `name`, also in a command that does not use that group.
    names = {*CHOICES, *(folder.name for folder in Path(conf.__path__[0]).iterdir() if folder.is_dir())}
    plain = {entry.path for entry in walk(SCHEMAS[command]) if "." not in entry.path}
    assert not plain & names


# Keys whose home is the signature of a function: command, key -> function, argument.
SIGNATURES = [
    (command, f"{group}{argument}", function, argument)
    for command, group, function, arguments in (
        ("train", "", nsde_torch.train, "seed device dtype"),
        ("train", "data.", nsde_torch.train, "validation"),
        ("train", "data.", nsde_torch.read, "gap clock"),
        ("train", "data.", simulation.simulated, "durations seed process_noise sensor_noise cache gap clock"),
        ("diagnose", "", nsde_torch.diagnose, "alpha max_effects candidates seed"),
        ("evaluate", "", nsde_torch.evaluate, "seed particles horizons bootstrap compile"),
        ("simulate", "", nsde_torch.simulate, "durations dt"),
        ("simulate", "plant.", nsde_torch.simulate, "declared_only process_noise sensor_noise battery"),
    )
    for argument in arguments.split()
]


@pytest.mark.parametrize(("command", "name", "function", "argument"), SIGNATURES)
def test_a_key_has_the_default_of_the_function_that_it_is_for(
    command: str, name: str, function: Any, argument: str
) -> None:
    chosen = {**groups.defaults(command)}
    (entry,) = [entry for entry in groups.keys(command, chosen) if entry.path == name]
    assert inspect.signature(function).parameters[argument].default == entry.default
