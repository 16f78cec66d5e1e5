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
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from nsde_torch.errors import ConfigError

if TYPE_CHECKING:
    from .hydra_command import HydraCommand


class Command(Protocol):
    """What a file of a command holds under the name `COMMAND`."""

    def main(self, arguments: Sequence[str], /) -> int:
        """Run the command with the words after its name; returns the exit status."""

    def complete(self, words: Sequence[str], /) -> list[str]:
        """Completions of the last of these words."""


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
        file = _file_of(self.module)
        try:
            line = (ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or "").partition("\n")[0]
        except (OSError, ValueError, SyntaxError):
            line = ""
        words = line.rpartition("`: ")[2].strip().removesuffix(".")
        return words[:1].upper() + words[1:] or f"A command of the package {self.package}"

    def load(self) -> Command:
        """Import the file of the command; ConfigError where that of another package fails."""
        try:
            command: Command = importlib.import_module(self.module, package=__package__).COMMAND
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
    """Where a module is, found without importing anything; a path that is none where it is not found."""
    from importlib.util import find_spec

    top, *below = module.split(".")
    if not top:  # one of ours
        return Path(__file__).parent.joinpath(*below).with_suffix(".py")
    try:
        spec = find_spec(top)
    except (ImportError, ValueError):
        spec = None
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

    entry = entry_of(name)
    command = None if entry is None else entry.load()
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
