"""Shell completion."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from nsde_torch.cli import groups
from nsde_torch.cli.commands.completion import SHELLS, query
from nsde_torch.cli.registry import all_commands
from tests.helpers.commands import Said


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["tr"], ["train", "track"]),
        (["completion", "z"], ["zsh"]),
        (["train", "sys"], ["system.", "system="]),
        (["train", "system=c"], ["system=cartpole"]),
        (["train", "-m", "loss=paper,r"], ["loss=paper,replay"]),
        (["train", "trainer.lr"], ["trainer.lr=", "trainer.lr_end="]),
        (["train", "dtype="], ["dtype=float32", "dtype=float64"]),
        (["train", "data.pa"], []),
        (["train", "data=csv", "data.pa"], ["data.path="]),
        (["train", "hydra/sweeper=o"], ["hydra/sweeper=optuna"]),
        (["train", "--conf"], ["--config-dir"]),
        (["nothing", "x"], []),
        (["evaluate", "ru"], ["run="]),
        (["evaluate", "data=csv", "data.pa"], ["data.path="]),
        (["evaluate", "data.te"], ["data.test=", "data.test_path="]),
        (["evaluate", "sensor_noise="], ["sensor_noise=train", "sensor_noise=data"]),
        (["evaluate", "--m"], []),
        (["effects", "sys"], ["system.", "system="]),
        (["effects", "system=hex"], ["system=hexacopter"]),
        (["effects", "format="], ["format=text", "format=json"]),
        (["inspect", "system=qua"], ["system=quadrotor"]),
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


def test_unknown_shell_is_refused(refused: Said) -> None:
    assert "bash, zsh, fish" in refused("completion", "tcsh")


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
