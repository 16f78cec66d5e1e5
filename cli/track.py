"""`nsde track`: fly a reference; the work is in `track_job`, which help and completion need not import."""

from __future__ import annotations

from collections.abc import Sequence

from .hydra_command import HydraCommand
from .quoted import from_file, quoted

COMMAND = HydraCommand(
    name="track",
    summary="Fly a reference with model predictive control on a learned model, and report errors and times",
    module=".track_job",
)


def main(arguments: Sequence[str]) -> int:
    """Run `nsde track` with these words; returns the exit status."""
    return COMMAND.main([quoted(quoted(from_file(word), "out_dir"), "run") for word in arguments])


def complete(words: Sequence[str]) -> list[str]:
    """Completions of the last word."""
    return COMMAND.complete(words)
