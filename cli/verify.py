"""`nsde verify FILE`: an exported controller against its model; the work is in `verify_job`."""

from __future__ import annotations

from collections.abc import Sequence

from .hydra_command import HydraCommand
from .quoted import quoted

COMMAND = HydraCommand(
    name="verify",
    summary="Hold an exported controller against the one that it was made of",
    module=".verify_job",
)


def main(arguments: Sequence[str]) -> int:
    """Run `nsde verify` with these words; returns the exit status."""
    words = [
        f"controller={w}" if k == 0 and w[:1] != "-" and "=" not in w else w for k, w in enumerate(arguments)
    ]
    for key in ("controller", "run", "log", "out"):
        words = [quoted(word, key) for word in words]
    return COMMAND.main(words)


def complete(words: Sequence[str]) -> list[str]:
    """Completions of the last word."""
    return COMMAND.complete(words)
