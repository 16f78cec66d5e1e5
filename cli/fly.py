"""`nsde fly`: fly on PX4; the work is in `fly_job`, which help and completion need not import."""

from __future__ import annotations

from collections.abc import Sequence

from .hydra_command import HydraCommand
from .quoted import from_file, quoted

COMMAND = HydraCommand(
    name="fly",
    summary="Fly a controller on a PX4 vehicle over MAVLink, with checks, limits and a log",
    module=".fly_job",
)


def main(arguments: Sequence[str]) -> int:
    """Run `nsde fly` with these words; returns the exit status."""
    return COMMAND.main([quoted(quoted(from_file(word), "out_dir"), "run") for word in arguments])


def complete(words: Sequence[str]) -> list[str]:
    """Completions of the last word."""
    return COMMAND.complete(words)
