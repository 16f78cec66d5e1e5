"""`nsde vehicle`: a simulated PX4 vehicle; the work is in `vehicle_job`."""

from __future__ import annotations

from collections.abc import Sequence

from .hydra_command import HydraCommand

COMMAND = HydraCommand(
    name="vehicle",
    summary="Be a simulated PX4 vehicle, for nsde fly and its tests",
    module=".vehicle_job",
)


def main(arguments: Sequence[str]) -> int:
    """Run `nsde vehicle` with these words; returns the exit status."""
    return COMMAND.main(_keys(arguments))


def _keys(arguments: Sequence[str]) -> list[str]:
    """`--hil URL` and `--hil=URL` as the key that they are."""
    out: list[str] = []
    words = iter(arguments)
    for word in words:
        if word == "--hil":
            word = f"--hil={next(words, '')}"
        out.append(word[2:] if word.startswith("--hil=") else word)
    return out


def complete(words: Sequence[str]) -> list[str]:
    """Completions of the last word."""
    return COMMAND.complete(words)
