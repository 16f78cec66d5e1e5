"""The keys of every command and their help are what they were, and Hydra composes what the help says."""

import contextlib
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from nsde_torch.cli import groups
from nsde_torch.cli.help import value_text
from nsde_torch.cli.hydra_command import store
from nsde_torch.cli.main import main
from nsde_torch.cli.registry import all_commands, hydra_commands
from tests.golden.kept import same_text

HERE = Path(__file__).parent
HYDRA = hydra_commands()


@pytest.fixture(scope="module")
def hydra_ready() -> Iterator[None]:
    for command in HYDRA.values():
        store(command)
    with initialize_config_module("nsde_torch.conf", version_base="1.3"):
        yield


def _chosen(command: str) -> list[dict[str, str]]:
    """Choices of every group, so few that each choice is among them; the first are the defaults."""
    known = {group: [first, *groups.choices(group)] for group, first in groups.defaults(command).items()}
    return [
        {group: of[k % len(of)] for group, of in known.items()}
        for k in range(max(map(len, known.values()), default=1))
    ]


def _once() -> dict[str, list[dict[str, str]]]:
    """Of each command its defaults, and of choices those that no command before it has."""
    seen: set[tuple[str, str]] = set()
    cases = {}
    for command in HYDRA:
        first, *more = _chosen(command)
        cases[command] = [first]
        seen |= {*first.items()}
        for chosen in more:
            cases[command] += [chosen] if {*chosen.items()} - seen else []
            seen |= {*chosen.items()}
    return cases


COMPOSED = _once()


@pytest.mark.usefixtures("hydra_ready")
@pytest.mark.parametrize("command", COMPOSED)
def test_hydra_composes_what_the_help_says_for_every_choice(command: str) -> None:
    defaults = groups.defaults(command)
    for chosen in COMPOSED[command]:
        wanted: dict[str, Any] = {}
        for entry in groups.keys(command, chosen):
            *parents, last = entry.path.split(".")
            place = wanted
            for parent in parents:
                place = place.setdefault(parent, {})
            place[last] = entry.default
        words = [f"{group}={choice}" for group, choice in chosen.items() if choice != defaults[group]]
        config = compose(command, overrides=words)
        # a command's own values win over those of a group's default, and where a choice has none
        for group, values in HYDRA[command].values.items():
            known = defaults[group] == groups.NOTHING
            wanted[group] |= {k: v for k, v in values.items() if not known or wanted[group][k] == "???"}
        # the help calls folders that a command writes into dated
        wanted |= {HYDRA[command].folder_key: HYDRA[command].folder} if HYDRA[command].folder else {}
        wanted |= {"sweep_dir": "multirun/${now:%Y-%m-%d}/${now:%H-%M-%S}"} if "sweep_dir" in wanted else {}
        assert OmegaConf.to_container(config) == wanted, chosen


def test_keys_of_groups_have_the_defaults_units_ranges_and_help_that_they_had(regenerate: bool) -> None:
    choices: dict[str, dict[str, None]] = defaultdict(dict)
    for command in HYDRA:
        for chosen in _chosen(command):
            for e in groups.keys(command, chosen):
                group, _, inside = e.path.partition(".")
                if inside:  # other keys are in the help of the command
                    choice = chosen.get(group, groups.NOTHING)
                    line = f"{e.path}={value_text(e.default)} [{e.unit}] ({e.allowed}) {e.help}"
                    choices[line][command if choice == groups.NOTHING else choice] = None
    own = {
        name: (of.values, of.folder_key, of.folder) for name, of in HYDRA.items() if of.values or of.folder
    }
    lines = [f"{name}: {values} {key}={folder}\n" for name, (values, key, folder) in own.items()]
    lines += [f"{' '.join(sorted(names))}: {line}\n" for line, names in choices.items()]
    same_text(HERE / "keys.txt", "".join(lines), regenerate=regenerate)


@pytest.mark.parametrize("command", all_commands())
def test_the_help_of_a_command_reads_as_it_did(
    command: str, regenerate: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    every = ["all"] if command == "train" else []  # elsewhere, of groups, those of keys.txt
    with contextlib.suppress(SystemExit):
        assert main([command, "--help", *every]) == 0
    same_text(HERE / "help" / f"{command}.txt", capsys.readouterr().out, regenerate=regenerate)


def test_the_list_of_commands_reads_as_it_did(regenerate: bool, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    same_text(HERE / "help" / "nsde.txt", capsys.readouterr().out, regenerate=regenerate)
