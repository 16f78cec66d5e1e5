"""`nsde evaluate`: score trained models; the work is in `evaluate_job`, which help and completion need not import."""

from __future__ import annotations

from collections.abc import Sequence

from .hydra_command import HydraCommand
from .quoted import quoted

COMMAND = HydraCommand(
    name="evaluate",
    summary="Score trained models on runs, against baselines and each other",
    module=".evaluate_job",
)


def main(arguments: Sequence[str]) -> int:
    """Run `nsde evaluate` with these words; returns the exit status."""
    return COMMAND.main([quoted(word, "run") for word in arguments])


def complete(words: Sequence[str]) -> list[str]:
    """Completions of the last word."""
    return COMMAND.complete(words)
