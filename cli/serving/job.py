"""A job of the page: limits, files, state, and the commands behind it."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, final

from nsde_torch.errors import NsdeError
from nsde_torch.whole_files import write_whole


@final
class RefusedError(NsdeError):
    """A request that is refused: one sentence with the remedy, and the status of HTTP."""

    def __init__(self, message: str, status: int = 400) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True)
class ServeLimits:
    """Limits of the service."""

    upload: int = 512 << 20  # largest upload of one job, all its logs together [bytes]
    max_minutes: float = 10.0  # time after which a diagnosis ends with what is known [min]
    seconds: float = 3600.0  # time after which a command is killed [s]
    memory: int = 8 << 30  # largest memory of one job [bytes]
    jobs: int = 1  # diagnoses at a time; further ones wait
    keep: int = 50  # most jobs that are kept
    files: int = 200  # most logs of one job


RECORD = "job.json"
STATES = {
    "uploading": "logs are being sent",
    "looking": "being looked into",
    "ready": "can be diagnosed",
    "refused": "cannot be diagnosed as it is",
    "waiting": "waits for its turn",
    "running": "being diagnosed",
    "done": "diagnosed",
    "failed": "not diagnosed",
    "cancelled": "stopped",
}
"""What a job can be, and what the page calls it."""
AT_WORK = ("looking", "waiting", "running")


@dataclass
class UploadedFile:
    """One log."""

    given: str  # its name as the browser said it
    name: str  # its name here
    size: int  # bytes that were announced
    there: bool = False  # whether it arrived


@dataclass
class ServedJob:
    """What is known of a job."""

    id: str  # its name and that of its folder; whoever knows it may see the results
    created: str  # when, ISO 8601
    system: str | None  # machine that was chosen; None: to be guessed
    files: list[UploadedFile]
    machine: str = ""  # what it is taken for
    state: str = "uploading"  # key of `STATES`
    sentence: str = ""  # why it is refused or failed; empty where it is not
    mapped: bool = False  # whether the user gave the mapping
    # what the diagnosis did: stage, number done, number in all, second at which it began, and what was found
    # so far
    stages: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0  # how long the diagnosis took or has taken
    repeat: str = ""  # the command that repeats the diagnosis

    def content(self) -> dict[str, Any]:
        """As plain containers."""
        return asdict(self)

    def save(self, folder: Path) -> None:
        """Write the record, whole or not at all."""
        write_whole(folder / RECORD, json.dumps(self.content(), indent=1) + "\n")


def load(folder: Path) -> ServedJob | None:
    """The job of a folder; None where there is none that can be read."""
    try:
        content = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        files = [UploadedFile(**one) for one in content.pop("files")]
        job = ServedJob(**content, files=files)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None
    return job if job.id == folder.name and job.state in STATES else None


@dataclass(frozen=True)
class Machines:
    """The machines that the page offers."""

    # choice of the group `system` -> name of the system, of the package or `module:Class`
    names: Mapping[str, str]
    folder: Path | None = None  # folder of the user's own choices (`--config-dir`), or None
    first: str | None = None  # the one that is chosen at first; None: chosen by what is logged
    typed: Sequence[str] = ()  # what was typed of it, `system.effects=[linear_drag]`

    @property
    def options(self) -> list[str]:
        """Words that make a command know them."""
        return [] if self.folder is None else ["--config-dir", str(self.folder)]


def machines(folder: Path | None, *, first: str | None = None, typed: Sequence[str] = ()) -> Machines:
    """Those of the package and of a folder of the user's own (`--config-dir`)."""
    from .. import groups

    values = {
        choice: groups.choice_values("system", choice, folder) for choice in groups.choices("system", folder)
    }
    named = {choice: str(v["name"]) for choice, v in values.items() if "name" in v}
    return Machines(named, None if folder is None else folder.resolve(), first, typed)


def inspect_words(
    logs: Path, *, known: Machines, system: str | None, mapping: Path | None, out: Path
) -> list[str]:
    """The words that look into logs of a system of `known`; None: guessed."""
    words = ["inspect", str(logs), "out=none", f"json={out}"]
    words += [f"system={known.names[system]}"] if system else []
    return [*words, f"mapping={mapping}"] if mapping else words


def diagnose_words(
    logs: Path, *, known: Machines, system: str, mapping: Path | None, max_minutes: float
) -> list[str]:
    """The words that diagnose logs, wherever they are typed; without a mapping where the reader needs none."""
    own = known.typed if system == known.first else ()
    words = ["diagnose", *known.options, f"system={system}", *own, "data=log", f"data.path={logs}"]
    words += [f"data.mapping={mapping}"] if mapping else []
    return [*words, "retrain=false", f"max_minutes={max_minutes:g}"]


def shell(words: Sequence[str]) -> str:
    """The words of a command, without `nsde`, as one line for a shell."""
    return f"nsde {shlex.join(words)}"
