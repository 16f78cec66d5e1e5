"""The table of commands, help, and what the shell completes."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nsde_torch.cli import groups
from nsde_torch.cli.commands.completion import SHELLS, query
from nsde_torch.cli.help import WIDTH, describe
from nsde_torch.cli.main import unknown_command
from nsde_torch.cli.registry import all_commands, hydra_commands
from tests.helpers.commands import Said, own_machine


@pytest.mark.parametrize("words", [[], ["--help"], ["-h"], ["help"]])
def test_alone_or_with_help_it_lists_every_command_with_a_line(words: list[str], shown: Said) -> None:
    lines = shown(*words).splitlines()
    for name, command in all_commands().items():
        assert any(line.split() == [name, *command.summary.split()] for line in lines)
    assert max(map(len, lines)) <= 100


def test_an_unknown_command_suggests_the_nearest_and_an_unknown_shell_is_refused(refused: Said) -> None:
    assert "bash, zsh, fish" in refused("completion", "tcsh")
    assert "Did you mean `nsde train`?" in refused("trian")
    assert "Did you mean" not in unknown_command("zzz")
    assert "Did you mean" not in unknown_command("nonsense")
    assert "Did you mean `nsde evaluate`?" in unknown_command("eval")


def test_help_starts_within_three_tenths_of_a_second() -> None:
    times = []
    for _ in range(6):
        start = time.perf_counter()
        subprocess.run([sys.executable, "-m", "nsde_torch.cli", "--help"], capture_output=True, check=True)
        times.append(time.perf_counter() - start)
    assert min(times) < 0.3


def _help(*words: str) -> str:
    return describe("train", list(words))


@pytest.mark.parametrize("words", [[], ["data=csv"], ["data=published", "trainer=fast", "loss=paper"]])
def test_help_fits_a_hundred_columns(words: list[str]) -> None:
    assert max(map(len, _help(*words).splitlines())) <= WIDTH


def test_help_follows_the_choices_on_the_command_line() -> None:
    assert "data.path=(required)" in _help("data=csv")
    assert "data.path=(required)" not in _help()
    fast = groups.choice_values("trainer", "fast")["steps"]
    assert f"trainer.steps={fast} " in _help("trainer=fast")


def test_help_shows_choices_of_the_users_own_folder(tmp_path: Path) -> None:
    own_machine(tmp_path, "name: my_module:Pendulum\ndt: 0.02\n")
    text = _help("--config-dir", str(tmp_path), "system=mine")
    assert "mine*" in text
    assert "system.name=my_module:Pendulum" in text
    assert "system.dt=0.02 [s]" in text


@pytest.mark.parametrize("command", [name for name in hydra_commands() if name != "benchmark"])
def test_help_fits_a_screen_and_all_of_it_is_a_word_away(command: str, shown: Said) -> None:
    short = shown(command, "--help").splitlines()
    whole = shown(command, "--help", "all").splitlines()
    assert len(short) <= 50
    assert set(whole) >= {line for line in short if "--help all" not in line}


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["tr"], ["train", "track"]),
        (["completion", "z"], ["zsh"]),
        (["train", "sys"], ["system.", "system="]),
        (["train", "system=c"], ["system=cartpole"]),
        (["train", "-m", "loss=paper,r"], ["loss=paper,replay"]),
        (["train", "trainer.lr"], ["trainer.lr=", "trainer.lr_end="]),
        (["train", "data.pa"], []),
        (["train", "data=csv", "data.pa"], ["data.path="]),
        (["train", "--conf"], ["--config-dir"]),
        (["nothing", "x"], []),
        (["evaluate", "ru"], ["run="]),
        (["evaluate", "--m"], []),
        (["effects", "format="], ["format=text", "format=json"]),
        (["inspect", "kind=ar"], ["kind=ardupilot"]),
    ],
)
def test_the_last_word_is_completed(words: list[str], expected: list[str]) -> None:
    assert query(words) == expected


def test_commands_groups_and_keys_are_all_reachable() -> None:
    assert set(all_commands()) <= set(query([""]))
    top = query(["train", ""])
    for group in groups.defaults("train"):
        assert f"{group}=" in top
        assert [word.split("=")[1] for word in query(["train", f"{group}="])] == groups.choices(group)
    for entry in groups.keys("train", groups.defaults("train")):
        assert f"{entry.path}=" in query(["train", entry.path])


def test_paths_are_completed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "flights").mkdir()
    (tmp_path / "flights" / "one.csv").touch()
    monkeypatch.chdir(tmp_path)
    assert query(["train", "data=csv", "data.path=fl"]) == ["data.path=flights/"]
    assert query(["train", "data=csv", "data.path=flights/o"]) == ["data.path=flights/one.csv"]
    assert query(["train", "--config-dir", "f"]) == ["flights/"]
    (tmp_path / "flown").mkdir()
    assert query(["evaluate", "run=[flown,fl"]) == ["run=[flown,flights/", "run=[flown,flown/"]


@pytest.mark.parametrize("shell", SHELLS)
def test_script_is_printed_and_parses(shell: str, shown: Said) -> None:
    script = shown("completion", shell)
    assert "completion query" in script
    found = shutil.which(shell)
    if found is None:
        pytest.skip(f"{shell} is not installed: its script is printed but not parsed")
    subprocess.run([found, "-n", "/dev/stdin"], input=script, text=True, check=True)


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("nsde trai", ["train "]),
        ("nsde train trainer.lr", ["trainer.lr=", "trainer.lr_end="]),
        ("nsde train -m loss=paper,r", ["paper,replay "]),
    ],
)
def test_bash_completes_a_line(line: str, expected: list[str], tmp_path: Path) -> None:
    program = tmp_path / "nsde"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m nsde_torch.cli "$@"\n')
    program.chmod(0o755)
    asked = f'COMP_LINE="{line}"; COMP_POINT=${{#COMP_LINE}}; _nsde_complete'
    script = f'eval "$(nsde completion bash)"; {asked}; printf "%s\\n" "${{COMPREPLY[@]}}"'
    env = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, env=env, check=True)
    assert done.stdout.splitlines() == expected
