"""`nsde diagnose`: find what a declared model lacks; the work is in `diagnose_job`."""

from __future__ import annotations

from collections.abc import Sequence

from .hydra_command import HydraCommand
from .quoted import quoted

COMMAND = HydraCommand(
    name="diagnose",
    summary="Find the effect that the declared physics lacks, add it, and report the error before and after",
    module=".diagnose_job",
)


def main(arguments: Sequence[str]) -> int:
    """Run `nsde diagnose` with these words; returns the exit status."""
    return COMMAND.main([quoted(word, "out_dir") for word in arguments])


def complete(words: Sequence[str]) -> list[str]:
    """Completions of the last word."""
    return COMMAND.complete(words)
