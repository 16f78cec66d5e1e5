"""`nsde export`: a controller as a file; the work is in `export_job`, which help and completion need not import."""

from __future__ import annotations

from collections.abc import Sequence

from .hydra_command import HydraCommand
from .quoted import quoted

COMMAND = HydraCommand(
    name="export",
    summary="Write the predictive controller as a file for a flight computer",
    module=".export_job",
)


def main(arguments: Sequence[str]) -> int:
    """Run `nsde export` with these words; returns the exit status."""
    return COMMAND.main([quoted(quoted(word, "out"), "run") for word in arguments])


def complete(words: Sequence[str]) -> list[str]:
    """Completions of the last word."""
    return COMMAND.complete(words)
