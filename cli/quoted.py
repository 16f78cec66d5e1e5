"""Folders on the command line: Hydra wants quotes around the `=` and `,` in the folders of a sweep's jobs."""

from __future__ import annotations

import re

_PLAIN = re.compile(r"[\w./:+@%~-]*|[\['\"$].*")


def quoted(word: str, key: str) -> str:
    """`KEY=DIR` with the quotes that DIR needs; any other word as it is."""
    name, _, value = word.partition("=")
    if name != key or _PLAIN.fullmatch(value):
        return word
    escaped = value.replace("\\", "\\\\").replace("'", "\\'")
    return f"{key}='{escaped}'"


def from_file(word: str) -> str:
    """`controller=FILE` as `run=FILE`: what is flown may be a run directory or a file of `nsde export`."""
    return f"run={word.partition('=')[2]}" if word.startswith("controller=") else word
