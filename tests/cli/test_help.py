"""`nsde train --help`."""

from __future__ import annotations

from pathlib import Path

import pytest

from nsde_torch.cli import groups
from nsde_torch.cli.help import WIDTH, describe, value_text
from nsde_torch.cli.main import main
from nsde_torch.cli.registry import hydra_commands


def _help(*words: str) -> str:
    return describe("train", list(words))


def test_help_shows_every_group_with_every_choice() -> None:
    text = _help()
    for group in groups.defaults("train"):
        for choice in groups.choices(group):
            assert choice in text


def test_help_shows_every_key_with_default_unit_and_meaning() -> None:
    text = " ".join(_help("all").split())
    for entry in groups.keys("train", groups.defaults("train")):
        assert f" {entry.path}=" in text
        assert " ".join(entry.help.split()) in text
        if entry.unit:
            assert f"[{entry.unit}]" in text


@pytest.mark.parametrize("words", [[], ["data=csv"], ["data=published", "trainer=fast", "loss=paper"]])
def test_help_fits_a_hundred_columns(words: list[str]) -> None:
    assert max(map(len, _help(*words).splitlines())) <= WIDTH


def test_help_follows_the_choices_on_the_command_line() -> None:
    assert "data.path=(required)" in _help("data=csv")
    assert "data.path=(required)" not in _help()
    fast = groups.choice_values("trainer", "fast")["steps"]
    assert f"trainer.steps={fast} " in _help("trainer=fast")


def test_help_shows_choices_of_the_users_own_folder(tmp_path: Path) -> None:
    (tmp_path / "system").mkdir()
    (tmp_path / "system" / "mine.yaml").write_text("name: my_module:Pendulum\ndt: 0.02\n")
    text = _help("--config-dir", str(tmp_path), "system=mine")
    assert "mine*" in text
    assert "system.name=my_module:Pendulum" in text
    assert "system.dt=0.02 [s]" in text


def test_defaults_are_printed_as_a_user_would_type_them() -> None:
    assert [value_text(v) for v in (None, True, [1, 2.5], 0.001, "a")] == [
        "null",
        "true",
        "[1,2.5]",
        "0.001",
        "a",
    ]


@pytest.mark.parametrize("command", [name for name in hydra_commands() if name != "benchmark"])
def test_help_fits_a_screen_and_all_of_it_is_a_word_away(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, "--help"]) == 0
    short = capsys.readouterr().out.splitlines()
    assert main([command, "--help", "all"]) == 0
    whole = capsys.readouterr().out.splitlines()
    assert len(short) <= 50
    assert set(whole) >= {line for line in short if "--help all" not in line}


def test_help_has_the_keys_of_the_groups_that_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "--help", "data=csv"]) == 0
    text = capsys.readouterr().out
    assert "data.path=" in text
    assert "\n  trainer.lr=" not in text
    assert "`--help all` has the keys of system, model, loss, trainer, solver too" in text
