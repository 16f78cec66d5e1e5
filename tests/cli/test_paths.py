"""Paths with every odd letter: each key of a file or folder takes them as they are, and printed commands too."""

import random
import shlex
from pathlib import Path
from typing import Any

import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser

import nsde_torch
from nsde_torch.cli import groups
from nsde_torch.cli.main import main
from nsde_torch.cli.quoted import as_typed, path_word, quoted, typed_path
from nsde_torch.cli.registry import hydra_commands
from nsde_torch.data import write_csv
from tests.helpers.commands import Said, own_machine

ODD = (
    *("ünï", "logs (1)", "[1]", "a=b", "a,b", "it's", 'say "hi"', "~x", "-x", "{x: 1}", "$HOME", "a\\b"),
    *("#1; ls", "007", "true", "1e3", " a ", "x" * 250),
)
ODDEST = ("a,b", "-x")
"""Read wrongly by one of the commands below before paths were quoted; the others go through the same function."""
COMMANDS = hydra_commands()


def told(word: str) -> Any:
    """What Hydra reads in a word."""
    return OverridesParser.create().parse_override(word).value()


@pytest.mark.parametrize("path", ODD)
@pytest.mark.parametrize("name", COMMANDS)
def test_every_key_of_a_file_takes_every_path(name: str, path: str) -> None:
    files = groups.files(name)
    assert files or name == "vehicle"
    for key, entry in files.items():
        word = f"{key}={path}"
        if key.endswith("effects"):
            made = told(path_word(f"{word}.yaml", files))
            assert made == ([f"{path}.yaml"] if key == "system.effects" else f"{path}.yaml"), key
        elif path == "[1]" and ("list" in entry.annotation or "Any" in entry.annotation):
            assert told(path_word(word, files)) in (["1"], [1]), key  # there brackets are a list
        else:
            assert told(path_word(word, files)) == path, key


def test_any_text_is_quoted_so_that_hydra_reads_it_back() -> None:
    rng = random.Random(1)
    for _ in range(400):
        text = "".join(rng.choice("aü '\"\\,=[](){}~#:;%|\t\n日1.-/") for _ in range(rng.randint(1, 12)))
        assert told(f"key={quoted(text)}") == text, repr(text)
        typed = shlex.split(as_typed(paths={"data.path": text}))[0]
        assert typed_path(typed.removeprefix("data.path=")).removeprefix("./") == text.removeprefix("./")


@pytest.mark.parametrize(
    ("word", "sweep", "expected"),
    [
        ("data.path=a,b", False, "a,b"),
        ("run=[ünï,b c]", False, ["ünï", "b c"]),
        ("run=['a,b',c]", False, ["a,b", "c"]),
        ("run='a b'", False, "a b"),
        ('data.path="it\'s"', False, "it's"),
        ("data.path=~/x", False, str(Path("~/x").expanduser())),
        ("data.path=./~/x", False, "./~/x"),
        ("data.mapping=null", False, None),
        ("run_dir=${now:%Y} x", False, "${now:%Y} x"),
        ("system.effects=[linear_drag,my effects.yaml]", False, ["linear_drag", "my effects.yaml"]),
        ("sweep_dir=a,b", True, "a,b"),
    ],
)
def test_lists_quotes_home_and_interpolations_keep_their_meaning(
    word: str, sweep: bool, expected: Any
) -> None:
    files = {**groups.files("train"), **groups.files("evaluate")}
    assert told(path_word(word, files, sweep=sweep)) == expected


def test_a_comma_separates_two_paths_in_a_sweep_alone() -> None:
    files = groups.files("train")
    swept = OverridesParser.create().parse_override(
        path_word("data.path=logs (1),ünï,'a,b'", files, sweep=True)
    )
    assert swept.is_sweep_override()
    assert list(swept.sweep_string_iterator()) == ["'logs (1)'", "'ünï'", "'a,b'"]
    assert path_word("data.path=choice(a,b)", files, sweep=True) == "data.path=choice(a,b)"
    assert told(path_word("data.path=choice(a,b)", files)) == "choice(a,b)"


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Runs of a spring in a folder of an odd name, reached by a link of another."""
    folder = tmp_path / 'ünï [1] (a=b), it\'s "~" {x} $HOME \\'
    made = nsde_torch.simulate("mass_spring_damper", durations=[3.0, 3.0, 3.0], seed=1)
    write_csv(nsde_torch.read(made, system="mass_spring_damper"), folder)
    link = tmp_path / "-líñk=x, y"
    link.symlink_to(folder)
    return link


@pytest.mark.usefixtures("elsewhere")
def test_the_command_that_an_inspection_prints_can_be_copied(runs: Path, shown: Said) -> None:
    line = shown("inspect", runs.name, "system=mass_spring_damper", "physics=false").splitlines()[-1]
    command, *words = shlex.split(line.removeprefix("next: "))
    assert command == "nsde"
    assert yaml.safe_load(shown(*words, "--cfg", "job"))["data"]["path"] == runs.name


@pytest.mark.slow
@pytest.mark.usefixtures("elsewhere")
def test_one_odd_path_is_trained_on_resumed_and_evaluated(runs: Path, tmp_path: Path, refused: Said) -> None:
    run = "rün (1), a=b"
    spring = ["system=mass_spring_damper", "model=sysid"]
    assert main(["train", *spring, f"data.path={runs.name}", f"run_dir={run}"]) == 0
    assert (tmp_path / run / "metrics.json").is_file()
    assert main(["train", f"resume={run}"]) == 0
    assert "rün (1) a=b`: no such folder" in refused("evaluate", f"run=[{run.replace(',', '')}]")
    assert main(["evaluate", f"run={run}", "particles=2", "bootstrap=100", "out_dir=[é]"]) == 0
    assert (tmp_path / "[é]" / "evaluation.json").is_file()


@pytest.mark.usefixtures("elsewhere")
def test_a_path_alone_chooses_the_reader_and_a_reader_that_is_named_wins(runs: Path, shown: Said) -> None:
    path = f"data.path={runs.name}"
    for words, kind in (([path], "log"), (["data=csv", path], "csv"), ([], "simulated")):
        assert yaml.safe_load(shown("train", "--cfg", "job", *words))["data"]["kind"] == kind
    assert nsde_torch.read(runs / "run_0.csv", system="mass_spring_damper").names == ("run_0",)


@pytest.mark.usefixtures("elsewhere")
def test_a_test_set_that_is_not_there_is_named_by_its_own_key(runs: Path, refused: Said) -> None:
    words = ["system=mass_spring_damper", "model=sysid", f"data.path={runs.name}", "data.test_path=nowhere"]
    assert "`data.test_path`: nowhere does not exist" in refused("train", *words)


def test_a_command_that_names_no_file_is_left_alone() -> None:
    for word in ("seed=1", "data.test=[0,1]", "--config-dir", "-m", "system.effects=[law[q2]]", "loss=a,b"):
        assert path_word(word, groups.files("train")) == word


@pytest.mark.usefixtures("elsewhere")
@pytest.mark.parametrize(
    "path", [path if path in ODDEST else pytest.param(path, marks=pytest.mark.slow) for path in ODD]
)
def test_inspection_the_report_of_a_sweep_and_the_folder_of_ones_own_machines_take_every_path(
    path: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], shown: Said
) -> None:
    folder = tmp_path / path
    folder.mkdir()
    (folder / "run.csv").write_text("t,q,q_dot\n" + "".join(f"{k / 100},{k},{100}\n" for k in range(50)))
    for words in ([path], ["--", path], [f"data.path={path}"]):
        assert main(["inspect", *words, "physics=false", "system=mass_spring_damper"]) in (0, 1)
        assert "1 run (run)" in capsys.readouterr().out
    (folder / "0_seed=1" / ".hydra").mkdir(parents=True)
    (folder / "0_seed=1" / ".hydra" / "overrides.yaml").write_text("- seed=1\n")
    (folder / "0_seed=1" / "metrics.json").write_text('{"validation": {"score": 1.0}}')
    assert "1 jobs: 1 done" in shown("sweep-report", path)
    assert (folder / "sweep_report.json").is_file()
    own_machine(folder, "defaults: [mass_spring_damper, _self_]\ndt: 0.02\n")
    for flag in ("--config-dir", "-cd"):
        job = shown("train", "seed=3", flag, path, "system=mine", "--cfg", "job")
        assert yaml.safe_load(job)["system"]["dt"] == 0.02
        assert "coulomb_friction" in shown("effects", flag, path, "system=mine")
