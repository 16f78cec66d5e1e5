"""The commands of `nsde`, each one line here and one file.

The file holds a `COMMAND`: a `HydraCommand` (name, schema, groups, folder) beside the function `run(config, job)`
that does its work, or a `PlainCommand` for one that Hydra does not configure. It is imported when its command is
called, so that listing the commands costs no import of Hydra or torch. What is heavy, torch above all, is imported
inside `run`: help, completion and the parent process of a launcher do without it.

Another package adds a command with an entry point of the group `nsde_torch.commands`, whose value is the module. The
first line of the module's docstring is what `nsde --help` and its own help say of it: "`nsde NAME`: what it does".
"""

from __future__ import annotations

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
    """One line of the table: the file of a command, and what `nsde --help` and its own help say of it."""

    module: str  # module with the `COMMAND`
    summary: str
    package: str | None = None  # installed package that adds the command; None for a command of the table

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
    name: CommandEntry(f".commands.{name.replace('-', '_')}", summary)
    for name, summary in {
        "inspect": "List what is in a log of any format, propose what its columns mean, and check it",
        "train": "Learn a neural SDE of a machine from simulated or measured runs",
        "diagnose": "Find the effect that the declared physics lacks, add it, and report the errors",
        "serve": "Open a page on this machine that takes dropped logs and gives their diagnosis",
        "design": "Plan the most informative experiment, or report the evidence of one that was flown",
        "evaluate": "Score trained models on runs, against baselines and each other",
        "policy": "Learn a policy in a learned model or on the true machine, and judge it there",
        "track": "Follow a reference with model predictive control on a learned model",
        "fly": "Fly a controller on a PX4 vehicle over MAVLink, with checks, limits and a log",
        "land": "Land a PX4 vehicle that is in the air, and watch until it is disarmed",
        "export": "Write the predictive controller as a file for a flight computer",
        "verify": "Hold an exported controller against the one that it was made of",
        "vehicle": "Be a simulated PX4 vehicle, for nsde fly and its tests",
        "close-loop": "Fly, find what the physics lacks, and fly again with it: tracking before and after",
        "simulate": "Write runs of a simulated machine as files that do not say what is in them",
        "effects": "List the physical effects that a system or a plant can be given",
        "sweep-report": "Rank the jobs of a sweep, and name those that failed and why",
        "completion": "Print the shell completion script for bash, zsh or fish",
    }.items()
}


def installed() -> dict[str, CommandEntry]:
    """Commands of other packages: their entry points of the group `nsde_torch.commands`."""
    from importlib.metadata import entry_points

    found = {}
    for point in entry_points(group="nsde_torch.commands"):
        package = point.dist.name if point.dist else "?"
        if point.name not in COMMANDS:
            summary = _summary(point.module) or f"A command of the package {package}"
            found[point.name] = CommandEntry(point.module, summary, package)
    return found


def _summary(module: str) -> str:
    """The first line of a module's docstring without the command's name. The file is read and nothing is imported."""
    import ast
    from importlib.util import find_spec

    top, *below = module.split(".")
    try:
        spec = find_spec(top)
        if spec is None or spec.origin is None:
            return ""
        path = Path(spec.origin)
        path = path.parent.joinpath(*below).with_suffix(".py") if below else path
        line = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").partition("\n")[0]
    except (ImportError, OSError, ValueError, SyntaxError):
        return ""
    words = line.rpartition("`: ")[2].strip().removesuffix(".")
    return words[:1].upper() + words[1:]


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
