"""The table of commands, and help."""

import time
from pathlib import Path

import pytest

from nsde_torch.cli import groups
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


def test_unknown_command_suggests_the_nearest(refused: Said) -> None:
    assert "Did you mean `nsde train`?" in refused("trian")
    assert "Did you mean" not in unknown_command("zzz")
    assert "Did you mean" not in unknown_command("nonsense")
    assert "Did you mean `nsde evaluate`?" in unknown_command("eval")


def test_version_is_that_of_the_package(shown: Said) -> None:
    assert shown("--version").split()[0] == "nsde"


def test_help_starts_within_three_tenths_of_a_second(nsde) -> None:  # type: ignore[no-untyped-def]
    nsde("--help")
    times = []
    for _ in range(5):
        start = time.perf_counter()
        assert nsde("--help").returncode == 0
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


def test_help_has_the_keys_of_the_groups_that_are_named(shown: Said) -> None:
    text = shown("train", "--help", "data=csv")
    assert "data.path=" in text
    assert "\n  trainer.lr=" not in text
    assert "`--help all` has the keys of system, model, loss, trainer, solver too" in text
