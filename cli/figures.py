"""`nsde figures`: the supplement's figures from data to picture; the work is in `figures_job`."""

from __future__ import annotations

from collections.abc import Sequence

from .hydra_command import HydraCommand

COMMAND = HydraCommand(
    name="figures",
    summary="Make the supplement's figures anew, each with its claim and what was measured",
    module=".figures_job",
)


def main(arguments: Sequence[str]) -> int:
    """Run `nsde figures` with these words; returns the exit status."""
    return COMMAND.main(arguments)


def complete(words: Sequence[str]) -> list[str]:
    """Completions of the last word."""
    return COMMAND.complete(words)
