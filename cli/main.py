"""`nsde COMMAND ...`: what is typed, to the command that it names."""

import os
import sys
from collections.abc import Sequence
from functools import partial
from typing import NoReturn

from nsde_torch.errors import NsdeError
from nsde_torch.lookup import did_you_mean
from nsde_torch.progress import WHEN_COMPILING

from .exit_status import OK, USER_ERROR
from .registry import all_commands, entry_of

_COMPILING = "compiling for this machine; later runs find it done"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command that words after `nsde` name, those of the process when None; the exit status (`exit_status`)."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help", "help"):
        print(listing())
        return OK
    if words[0] in ("-V", "--version"):
        from importlib import metadata

        print(f"nsde {metadata.version('nsde_torch')}")
        return OK
    name, rest = words[0], words[1:]
    known = entry_of(name)
    if known is None:
        print(unknown_command(name), file=sys.stderr)
        return USER_ERROR
    try:
        return known.load().main(rest)
    except NsdeError as error:
        print(f"nsde {name}: {error}", file=sys.stderr)
        return USER_ERROR


def entry() -> NoReturn:
    """Console script: `main`, with a closed pipe (`nsde train --help | head`) taken as a normal end."""
    for library in ("OPENBLAS", "OMP", "MKL"):
        # before numpy is imported: on a busy machine its small products take twenty times longer with two threads
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    WHEN_COMPILING.append(partial(print, _COMPILING, file=sys.stderr, flush=True))
    try:
        status = main()
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = OK
    sys.exit(status)


def listing() -> str:
    known = all_commands()
    width = max(map(len, known))
    rows = "\n".join(f"  {name:<{width}}  {command.summary}" for name, command in known.items())
    return (
        "nsde: learn a stochastic model of a machine from its data, and know where the model is ignorant\n\n"
        f"Usage: nsde COMMAND [arguments]\n\nCommands:\n{rows}\n\n"
        "`nsde COMMAND --help` describes a command, `nsde --version` prints the version."
    )


def unknown_command(name: str) -> str:
    """The message for a command that is not in the table, with the nearest one that is."""
    known = all_commands()
    hint = did_you_mean(name, known, "`nsde {}`", cutoff=0.65)
    return (
        f"nsde: no command `{name}`.{hint} Commands: {', '.join(known)}. A command of another package is known once "
        "that package is installed; after an update of a checkout, run `pip install -e .` there again."
    )
