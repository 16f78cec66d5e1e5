"""`nsde policy`: learn to control; the work is in `policy_job`, which help and completion need not import."""

from __future__ import annotations

from collections.abc import Sequence

from .hydra_command import HydraCommand
from .quoted import quoted

COMMAND = HydraCommand(
    name="policy",
    summary="Learn a policy in a learned model or on the true machine, and judge it there",
    module=".policy_job",
)


def main(arguments: Sequence[str]) -> int:
    """Run `nsde policy` with these words; returns the exit status."""
    sweep = "-m" in arguments or "--multirun" in arguments  # there a comma is between two folders
    return COMMAND.main(list(arguments) if sweep else [quoted(word, "environment") for word in arguments])


def complete(words: Sequence[str]) -> list[str]:
    """Completions of the last word."""
    return COMMAND.complete(words)
