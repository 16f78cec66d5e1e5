"""Config groups, their choices and the values that a choice sets, read from the YAML files without Hydra.

Help and shell completion start at every key press, so they read the few files that they need by themselves.
"""

import contextlib
import dataclasses
import os
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from nsde_torch.errors import ConfigError
from nsde_torch.plain_yaml import read_yaml

from .keys import Key, walk
from .registry import hydra_command
from .schemas import CHOICES, NAMES

_CONF = "nsde_torch.conf"
NOTHING = "null"


def config_dir(words: Sequence[str]) -> Path | None:
    """The folder that `--config-dir` (or `-cd`) names, if any."""
    for index, word in enumerate(words):
        if word in ("--config-dir", "-cd") and index + 1 < len(words):
            return Path(words[index + 1])
        if word.startswith("--config-dir="):
            return Path(word.split("=", 1)[1])
    return None


def check_own_files(folder: Path, chosen: Mapping[str, str]) -> None:
    """Refuse choices of `--config-dir` that are no plain YAML, which could name objects of Python, or hold no keys."""
    for group, choice in chosen.items():
        for name in _composed(group, choice, folder)[0]:
            if (file := folder / group / f"{name}.yaml").is_file():
                content = read_yaml(file)
                if not isinstance(content, dict | None):
                    raise ConfigError(f"{file} must hold `KEY: VALUE` lines; got {type(content).__name__}.")


def schema(command: str) -> type:
    return hydra_command(command).schema


def defaults(command: str) -> dict[str, str]:
    """The config groups of a command with the choice that each has by default, in order; `null` for none."""
    return {name: choice or NOTHING for name, choice in hydra_command(command).groups.items()}


def sweeps(command: str) -> bool:
    """Whether a command takes -m: one with a folder for its jobs."""
    return "sweep_dir" in hydra_command(command).keys


def choices(group: str, extra: Path | None = None) -> list[str]:
    """The choices of a group, those of the user's own config folder included."""
    names = {*_package_files(group), *CHOICES.get(group, {}), *NAMES.get(group, ())}
    if extra is not None and (extra / group).is_dir():
        names |= {path.stem for path in (extra / group).glob("*.yaml")}
    return sorted(names)


def every_key(command: str) -> list[Key]:
    """The keys of a command, whatever is chosen in its groups."""
    found = list(walk(schema(command)))
    for group in defaults(command):
        found += [entry for own in CHOICES.get(group, {}).values() for entry in walk(own, f"{group}.")]
    return found


def files(command: str) -> dict[str, Key]:
    """The keys of a command that name files or folders."""
    return {entry.path: entry for entry in every_key(command) if entry.file}


def without_file(group: str) -> dict[str, Any]:
    """Choices of a group that are all that their dataclass says, or set their name alone: they need no file."""
    nodes = {**CHOICES.get(group, {}), **{name: {"name": name} for name in NAMES.get(group, ())}}
    return {name: node for name, node in nodes.items() if name not in _package_files(group)}


def selected(command: str, words: Sequence[str]) -> dict[str, str]:
    """The choice of every group once the overrides on the command line are taken into account."""
    chosen = defaults(command)
    for word in words:
        name, _, value = word.partition("=")
        if name in chosen and value:
            chosen[name] = value
    return chosen


def keys(command: str, chosen: dict[str, str], extra: Path | None = None) -> Iterator[Key]:
    """Every key of a command for one choice of each group; defaults are what the choice's file says."""
    # the command's own values are composed over those of a choice, but for what is chosen in a group without a default
    of_command, first = hydra_command(command).values, hydra_command(command).groups
    values: dict[str, dict[str, Any]] = {}
    for group, choice in chosen.items():
        values[group] = {} if choice == NOTHING else choice_values(group, choice, extra)
        if choice == NOTHING or first.get(group) is not None:
            values[group] |= of_command.get(group) or {}
    done: set[str] = set()
    for entry in walk(schema(command)):
        group = entry.path.split(".")[0]
        if group not in chosen:
            yield entry
        elif group not in done:
            done.add(group)
            for own in walk(group_schema(command, group, chosen[group], extra), f"{group}."):
                value = values[group].get(own.path.split(".", 1)[1], own.default)
                yield dataclasses.replace(own, default=value)


def typed_keys(command: str, words: Sequence[str]) -> Iterator[Key]:
    """Every key of a command for the choices among the words, and those of the folder that they name."""
    return keys(command, selected(command, words), config_dir(words))


def group_schema(command: str, group: str, choice: str, extra: Path | None = None) -> type:
    """The dataclass of a choice: its own, that of the choice it builds on, or that of its group."""
    from typing import get_type_hints

    own = CHOICES.get(group, {})
    found = next((own[name] for name in _composed(group, choice, extra)[0] if name in own), None)
    return found or get_type_hints(schema(command))[group]


def choice_values(group: str, choice: str, extra: Path | None = None) -> dict[str, Any]:
    """The values that a choice's file sets, on top of those of the choices it builds on."""
    return _composed(group, choice, extra)[1]


def _composed(group: str, choice: str, extra: Path | None) -> tuple[list[str], dict[str, Any]]:
    """A choice and those that it builds on, and the values that they set."""
    content = _read(group, choice, extra)
    names, values = [choice], dict[str, Any]()
    for item in content.pop("defaults", []):
        if isinstance(item, str) and "/" not in item and item not in ("_self_", choice):
            parents, inherited = _composed(group, item, extra)
            names += parents
            values |= inherited
    return names, values | content


def _read(group: str, choice: str, extra: Path | None) -> dict[str, Any]:
    content = None
    own = None if extra is None else extra / group / f"{choice}.yaml"
    if choice in (files := _package_files(group)):
        content = yaml.safe_load(files[choice].read_text(encoding="utf-8"))
    elif choice in NAMES.get(group, ()):
        content = {"name": choice}
    elif own is not None and os.path.isfile(own):
        with contextlib.suppress(ConfigError):  # the command says so once it runs
            content = read_yaml(own)
    return content if isinstance(content, dict) else {}


def _package_files(group: str) -> dict[str, Any]:
    """Choice -> file of the package that sets its values."""
    folder = resources.files(_CONF).joinpath(group)
    files = folder.iterdir() if folder.is_dir() else ()
    return {item.name.removesuffix(".yaml"): item for item in files if item.name.endswith(".yaml")}
