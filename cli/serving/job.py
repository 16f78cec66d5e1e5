"""One job of the page: logs, what is in them, their diagnosis; a folder with `job.json`."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from nsde_torch.whole_files import write_whole

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
    """One log.

    Args:
        given: Its name as the browser said it.
        name: Its name here.
        size: Bytes that were announced.
        there: Whether it arrived.
    """

    given: str
    name: str
    size: int
    there: bool = False


@dataclass
class ServedJob:
    """What is known of a job.

    Args:
        id: Its name and that of its folder; whoever knows it may see the results.
        created: When, ISO 8601.
        system: Machine that was chosen; None: to be guessed.
        files: Its logs.
        machine: What it is taken for.
        state: Key of `STATES`.
        sentence: Why it is refused or failed; empty where it is not.
        mapped: Whether the user gave the mapping.
        stages: What the diagnosis did: stage, number done, number in all, second at which it began, and
            what was found so far.
        seconds: How long the diagnosis took or has taken.
        repeat: The command that repeats the diagnosis.
    """

    id: str
    created: str
    system: str | None
    files: list[UploadedFile]
    machine: str = ""
    state: str = "uploading"
    sentence: str = ""
    mapped: bool = False
    stages: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0
    repeat: str = ""

    def content(self) -> dict[str, Any]:
        """As plain containers."""
        return asdict(self)

    def save(self, folder: Path) -> None:
        """Write the record, whole or not at all.

        Args:
            folder: Of the job.
        """
        write_whole(folder / RECORD, json.dumps(self.content(), indent=1) + "\n")


def load(folder: Path) -> ServedJob | None:
    """The job of a folder; None where there is none that can be read.

    Args:
        folder: Of the job.
    """
    try:
        content = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        files = [UploadedFile(**one) for one in content.pop("files")]
        job = ServedJob(**content, files=files)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None
    return job if job.id == folder.name and job.state in STATES else None
