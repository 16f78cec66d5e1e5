"""`nsde evaluate`: score trained models; the work is in `evaluate_job`, which help and completion need not import."""

from __future__ import annotations

import re
from collections.abc import Sequence

from .hydra_command import HydraCommand

COMMAND = HydraCommand(
    name="evaluate",
    summary="Score trained models on runs, against baselines and each other",
    module=".evaluate_job",
)
_PLAIN = re.compile(r"[\w./:+@%~-]*|[\['\"$].*")


def main(arguments: Sequence[str]) -> int:
    """Run `nsde evaluate` with these words; returns the exit status."""
    return COMMAND.main([_quoted(word) for word in arguments])


def complete(words: Sequence[str]) -> list[str]:
    """Completions of the last word."""
    return COMMAND.complete(words)


def _quoted(word: str) -> str:
    """`run=DIR` with the quotes that Hydra wants around the `=` and `,` in the folders of a sweep's jobs."""
    name, _, value = word.partition("=")
    if name != "run" or _PLAIN.fullmatch(value):
        return word
    escaped = value.replace("\\", "\\\\").replace("'", "\\'")
    return f"run='{escaped}'"
