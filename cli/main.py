"""`nsde COMMAND ...`: the table of commands.

A command is one module with `main(arguments) -> exit status` and, if it has something to complete,
`complete(words) -> choices`. Adding a command is adding one line to `COMMANDS`. A module is imported when its
command is called, so that listing the commands costs no import of Hydra or torch.
"""

from __future__ import annotations

import difflib
import importlib
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import NoReturn

from .exit_status import OK, USER_ERROR


@dataclass(frozen=True)
class Command:
    """One row of the table: the module that holds the command and the line that describes it."""

    module: str
    summary: str

    def load(self) -> ModuleType:
        """Import the command's module."""
        return importlib.import_module(self.module, package=__package__)


COMMANDS: dict[str, Command] = {
    "train": Command(".train", "Learn a neural SDE of a machine from simulated or measured runs"),
    "diagnose": Command(
        ".diagnose", "Find the effect that the declared physics lacks, add it, and report the errors"
    ),
    "evaluate": Command(".evaluate", "Score trained models on runs, against baselines and each other"),
    "figures": Command(
        ".figures", "Make the supplement's figures anew, each with its claim and what was measured"
    ),
    "policy": Command(
        ".policy", "Learn a policy in a learned model or on the true machine, and judge it there"
    ),
    "track": Command(".track", "Fly a reference with model predictive control on a learned model"),
    "fly": Command(".fly", "Fly a controller on a PX4 vehicle over MAVLink, with checks, limits and a log"),
    "export": Command(".export", "Write the predictive controller as a file for a flight computer"),
    "verify": Command(".verify", "Hold an exported controller against the one that it was made of"),
    "vehicle": Command(".vehicle", "Be a simulated PX4 vehicle, for nsde fly and its tests"),
    "close-loop": Command(
        ".close_loop", "Fly, find what the physics lacks, and fly again with it: tracking before and after"
    ),
    "simulate": Command(
        ".simulate", "Write runs of a simulated machine as files that do not say what is in them"
    ),
    "effects": Command(".effects", "List the physical effects that a system or a plant can be given"),
    "sweep-report": Command(".sweep_report", "Rank the jobs of a sweep, and name those that failed and why"),
    "completion": Command(".completion", "Print the shell completion script for bash, zsh or fish"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: Words after `nsde`; those of the process when None.

    Returns:
        Exit status: 0 done, 1 some jobs of a sweep failed, 2 a fault of the user's input, 130 interrupted.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help", "help"):
        print(listing())
        return OK
    if words[0] in ("-V", "--version"):
        print(f"nsde {version()}")
        return OK
    name, rest = words[0], words[1:]
    if name not in COMMANDS:
        print(unknown_command(name), file=sys.stderr)
        return USER_ERROR
    status: int = COMMANDS[name].load().main(rest)
    return status


def entry() -> NoReturn:
    """Console script: `main`, with a closed pipe (`nsde train --help | head`) taken as a normal end."""
    for library in ("OPENBLAS", "OMP", "MKL"):
        # before numpy is imported: on a busy machine its small products take twenty times longer with two threads
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    try:
        status = main()
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = OK
    sys.exit(status)


def listing() -> str:
    """The commands with a line each."""
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:<{width}}  {command.summary}" for name, command in COMMANDS.items())
    return (
        "nsde: learn a stochastic model of a machine from its data, and know where the model is ignorant\n\n"
        f"Usage: nsde COMMAND [arguments]\n\nCommands:\n{rows}\n\n"
        "`nsde COMMAND --help` describes a command, `nsde --version` prints the version."
    )


def unknown_command(name: str) -> str:
    """The message for a command that is not in the table, with the nearest one that is."""
    near = difflib.get_close_matches(name, COMMANDS, n=1, cutoff=0.5)
    hint = f" Did you mean `nsde {near[0]}`?" if near else ""
    return f"nsde: no command `{name}`.{hint} Commands: {', '.join(COMMANDS)}."


def version() -> str:
    """The version of the installed package."""
    from importlib import metadata

    return metadata.version("nsde_torch")
