"""The commands of `nsde`, each a name here and one file.

The file holds a `COMMAND`: a `HydraCommand` (name, schema, groups, folder) beside the function `run(config, job)`
that does its work, or a `PlainCommand` for one that Hydra does not configure. It is imported when its command is
called, so that listing the commands costs no import of Hydra or torch. What is heavy, torch above all, is imported
inside `run`: help, completion and the parent process of a launcher do without it.

The first line of its docstring is what `nsde --help` and its own help say of it: "`nsde NAME`: what it does". Another
package adds a command with an entry point of the group `nsde_torch.commands`, whose value is the module.
"""

from __future__ import annotations

import ast
import importlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from nsde_torch.errors import ConfigError

if TYPE_CHECKING:
    from .hydra_command import HydraCommand


@dataclass(frozen=True)
class PlainCommand:
    """A command that reads its words itself; what it cannot do with them it raises as an `NsdeError`."""

    main: Callable[[Sequence[str]], int]
    complete: Callable[[Sequence[str]], list[str]]


@dataclass(frozen=True)
class CommandEntry:
    """One line of the table: the file of a command."""

    module: str  # module with the `COMMAND`
    package: str | None = None  # installed package that adds the command; None for a command of the table

    @property
    def summary(self) -> str:
        """What `nsde --help` and its own help say of it: the first line of its docstring, without its name."""
        line = ""
        with suppress(Exception):  # a broken package ends no help
            text = _file_of(self.module).read_text(encoding="utf-8")
            line = (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0]
        words = line.rpartition("`: ")[2].strip().removesuffix(".")
        return words[:1].upper() + words[1:] or f"A command of the package {self.package}"

    def load(self) -> HydraCommand | PlainCommand:
        """Import the file of the command; ConfigError where that of another package fails."""
        try:
            command: HydraCommand | PlainCommand = importlib.import_module(self.module, __package__).COMMAND
        except (ImportError, AttributeError, TypeError) as error:
            if self.package is None:
                raise
            raise ConfigError(
                f"a command of the package {self.package} does not load ({error}). Install that package again; in "
                "its checkout with `pip install -e .`."
            ) from error
        return command


COMMANDS: dict[str, CommandEntry] = {
    name: CommandEntry(f".commands.{name.replace('-', '_')}")
    for name in (
        *("inspect", "train", "diagnose", "serve", "design", "evaluate", "policy", "track", "fly", "land"),
        *("export", "verify", "vehicle", "close-loop", "simulate", "effects", "sweep-report", "completion"),
    )
}


def installed() -> dict[str, CommandEntry]:
    """Commands of other packages: their entry points of the group `nsde_torch.commands`."""
    from importlib.metadata import entry_points

    points = [p for p in entry_points(group="nsde_torch.commands") if p.name not in COMMANDS]
    return {p.name: CommandEntry(p.module, p.dist.name if p.dist else "?") for p in points}


def _file_of(module: str) -> Path:
    """Where a module is, found without importing anything of its package."""
    top, *below = module.split(".")
    spec = find_spec(top or __name__)  # without a package one of ours
    path = Path(spec.origin if spec and spec.origin else "")
    return path.parent.joinpath(*below).with_suffix(".py") if below else path


def all_commands() -> dict[str, CommandEntry]:
    """Every command by name: those of the table, then those of other packages."""
    return {**COMMANDS, **installed()}


def entry_of(name: str) -> CommandEntry | None:
    """The line of a command; None where no package has it."""
    return COMMANDS.get(name) or installed().get(name)


def hydra_command(name: str) -> HydraCommand:
    """A command that Hydra configures; KeyError for none of that name, ConfigError where its package does not load."""
    from .hydra_command import HydraCommand

    command = entry.load() if (entry := entry_of(name)) else None
    if not isinstance(command, HydraCommand):
        raise KeyError(name)
    return command


def hydra_commands() -> dict[str, HydraCommand]:
    """All commands that Hydra configures, by name; those of other packages only if their modules load."""
    from .hydra_command import HydraCommand

    found = {}
    for name, entry in all_commands().items():
        # a broken package ends its own command, and no other
        with suppress(ConfigError):
            command = entry.load()
            if isinstance(command, HydraCommand):
                found[name] = command
    return found
