"""`nsde train`: learn a model; the work is in `train_job`, which help and completion need not import."""

from __future__ import annotations

from collections.abc import Sequence

from .hydra_command import HydraCommand

COMMAND = HydraCommand(
    name="train",
    summary="Learn a neural SDE of a machine from simulated or measured runs",
    module=".train_job",
)


def main(arguments: Sequence[str]) -> int:
    """Run `nsde train` with these words; returns the exit status."""
    return COMMAND.main(arguments)


def complete(words: Sequence[str]) -> list[str]:
    """Completions of the last word."""
    return COMMAND.complete(words)
