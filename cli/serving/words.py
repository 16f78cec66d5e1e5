"""The commands behind the page, as a shell takes them."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Machines:
    """The machines that the page offers.

    Args:
        names: Choice of the group `system` -> name of the system, of the package or `module:Class`.
        folder: Folder of the user's own choices (`--config-dir`), or None.
        first: The one that is chosen at first; None: told by what is logged.
        typed: What was typed of it, `system.effects=[linear_drag]`.
    """

    names: Mapping[str, str]
    folder: Path | None = None
    first: str | None = None
    typed: Sequence[str] = ()

    @property
    def options(self) -> list[str]:
        """Words that make a command know them."""
        return [] if self.folder is None else ["--config-dir", str(self.folder)]


def machines(folder: Path | None, *, first: str | None = None, typed: Sequence[str] = ()) -> Machines:
    """Those of the package and of a folder of the user's own.

    Args:
        folder: What `--config-dir` names.
        first: The one that is chosen at first.
        typed: What was typed of it.
    """
    from .. import groups

    values = {
        choice: groups.choice_values("system", choice, folder) for choice in groups.choices("system", folder)
    }
    named = {choice: str(v["name"]) for choice, v in values.items() if "name" in v}
    return Machines(named, None if folder is None else folder.resolve(), first, typed)


def inspect_words(
    logs: Path, *, known: Machines, system: str | None, mapping: Path | None, out: Path
) -> list[str]:
    """The words that look into logs.

    Args:
        logs: Folder of the logs.
        known: Machines that the page offers.
        system: One of them; None: guessed.
        mapping: A mapping to check in place of a proposal.
        out: JSON file of what is found.
    """
    words = ["inspect", str(logs), "out=none", f"json={out}"]
    words += [f"system={known.names[system]}"] if system else []
    return [*words, f"mapping={mapping}"] if mapping else words


def diagnose_words(
    logs: Path, *, known: Machines, system: str, mapping: Path | None, max_minutes: float
) -> list[str]:
    """The words that diagnose logs, wherever they are typed.

    Args:
        logs: Folder of the logs.
        known: Machines that the page offers.
        system: One of them.
        mapping: What columns mean; None: the reader needs none.
        max_minutes: Time after which it ends with what is known [min].
    """
    own = known.typed if system == known.first else ()
    words = ["diagnose", *known.options, f"system={system}", *own, "data=log", f"data.path={logs}"]
    words += [f"data.mapping={mapping}"] if mapping else []
    return [*words, "retrain=false", f"max_minutes={max_minutes:g}"]


def shell(words: Sequence[str]) -> str:
    """Words as one line for a shell.

    Args:
        words: A command, without `nsde`.
    """
    return f"nsde {shlex.join(words)}"
