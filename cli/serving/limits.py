"""How much the page may take of this machine."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ServeLimits:
    """Limits of what is served.

    Args:
        upload: Largest upload of one job, all its logs together [bytes].
        max_minutes: Time after which a diagnosis ends with what is known [min].
        seconds: Time after which a command is killed [s].
        memory: Largest memory of one job [bytes].
        jobs: Diagnoses at a time; further ones wait.
        keep: Most jobs that are kept.
        files: Most logs of one job.
    """

    upload: int = 512 << 20
    max_minutes: float = 10.0
    seconds: float = 3600.0
    memory: int = 8 << 30
    jobs: int = 1
    keep: int = 50
    files: int = 200
