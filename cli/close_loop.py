"""`nsde close-loop`: fly, diagnose, fly again; the work is in `close_loop_job`."""

from __future__ import annotations

from collections.abc import Sequence

from .hydra_command import HydraCommand
from .quoted import quoted

COMMAND = HydraCommand(
    name="close-loop",
    summary="Fly, find what the physics lacks, and fly again with it: tracking before and after",
    module=".close_loop_job",
)


def main(arguments: Sequence[str]) -> int:
    """Run `nsde close-loop` with these words; returns the exit status."""
    return COMMAND.main([quoted(word, "out_dir") for word in arguments])


def complete(words: Sequence[str]) -> list[str]:
    """Completions of the last word."""
    return COMMAND.complete(words)
