"""The configuration of every command and its help are what they were."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from nsde_torch.cli import groups
from nsde_torch.cli.help import value_text
from nsde_torch.cli.keys import walk
from nsde_torch.cli.main import main
from nsde_torch.cli.registry import all_commands, hydra_commands
from nsde_torch.cli.schemas import CHOICES
from nsde_torch.cli.store import store
from tests.golden.kept import same_text, same_values

HERE = Path(__file__).parent
HYDRA = hydra_commands()


@pytest.fixture(scope="module")
def hydra_ready() -> Iterator[None]:
    for command in HYDRA.values():
        store(command)
    with initialize_config_module("nsde_torch.conf", version_base="1.3"):
        yield


@pytest.mark.usefixtures("hydra_ready")
@pytest.mark.parametrize("command", HYDRA)
def test_a_command_composes_what_it_did(command: str, regenerate: bool) -> None:
    text = OmegaConf.to_yaml(compose(command))
    same_text(HERE / "config" / f"{command}.yaml", text, regenerate=regenerate)


@pytest.mark.usefixtures("hydra_ready")
def test_every_choice_of_every_group_sets_what_it_did(regenerate: bool) -> None:
    found: dict[str, Any] = {}
    for command in HYDRA:
        known = {group: groups.choices(group) for group in groups.defaults(command)}
        new = {group: of for group, of in known.items() if f"{group}={of[0]}" not in found}
        found |= {f"{group}={choice}": None for group, of in new.items() for choice in of}
        # one composition for a choice of every group
        for k in range(max(map(len, new.values()), default=0)):
            chosen = {group: of[k % len(of)] for group, of in new.items()}
            config = compose(command, overrides=[f"{group}={choice}" for group, choice in chosen.items()])
            for group, choice in chosen.items():
                found[f"{group}={choice}"] = OmegaConf.to_container(config[group])
    same_values(HERE / "choices.json", found, regenerate=regenerate)


def test_every_key_has_the_default_unit_range_and_help_that_it_had(regenerate: bool) -> None:
    own = {f"{group}={name}": cls for group, of in CHOICES.items() for name, cls in of.items()}
    every = {**{name: command.schema for name, command in HYDRA.items()}, **own}
    lines = [
        f"{name}: {e.path}={value_text(e.default)} [{e.unit}] ({e.allowed}) {e.help}"
        for name, cls in sorted(every.items())
        for e in walk(cls)
    ]
    same_text(HERE / "keys.txt", "\n".join(lines) + "\n", regenerate=regenerate)


@pytest.mark.parametrize("command", all_commands())
def test_the_help_of_a_command_reads_as_it_did(
    command: str, regenerate: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    with contextlib.suppress(SystemExit):
        assert main([command, "--help", "all"]) == 0
    same_text(HERE / "help" / f"{command}.txt", capsys.readouterr().out, regenerate=regenerate)


def test_the_list_of_commands_reads_as_it_did(regenerate: bool, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    same_text(HERE / "help" / "nsde.txt", capsys.readouterr().out, regenerate=regenerate)
