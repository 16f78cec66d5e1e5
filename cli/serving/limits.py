"""How much the page may take of this machine."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ServeLimits:
    """Limits of what is served.

    Args:
        upload: Largest upload of one job, all its logs together [bytes].
        seconds: Longest time of one job [s].
        memory: Largest memory of one job [bytes].
        jobs: Diagnoses at a time; further ones wait.
        keep: Most jobs that are kept.
        files: Most logs of one job.
    """

    upload: int = 512 << 20
    seconds: float = 3600.0
    memory: int = 8 << 30
    jobs: int = 1
    keep: int = 50
    files: int = 200
