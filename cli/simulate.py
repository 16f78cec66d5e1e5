"""`nsde simulate`: data sets of a plant; the work is in `simulate_job`, which help and completion need not import."""

from __future__ import annotations

from collections.abc import Sequence

from .hydra_command import HydraCommand
from .quoted import quoted

COMMAND = HydraCommand(
    name="simulate",
    summary="Write runs of a simulated machine as files that do not say what is in them",
    module=".simulate_job",
)


def main(arguments: Sequence[str]) -> int:
    """Run `nsde simulate` with these words; returns the exit status."""
    return COMMAND.main([quoted(quoted(word, "out"), "truth") for word in arguments])


def complete(words: Sequence[str]) -> list[str]:
    """Completions of the last word."""
    return COMMAND.complete(words)
