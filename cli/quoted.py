"""Folders on the command line: Hydra wants quotes around the `=` and `,` in the folders of a sweep's jobs."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence

_PLAIN = re.compile(r"[\w./:+@%~-]*|[\['\"$].*")


def quoted(word: str, keys: Collection[str]) -> str:
    """`KEY=DIR` with the quotes that DIR needs, for one of these keys; any other word as it is."""
    name, _, value = word.partition("=")
    if name not in keys or _PLAIN.fullmatch(value):
        return word
    escaped = value.replace("\\", "\\\\").replace("'", "\\'")
    return f"{name}='{escaped}'"


def from_file(words: Sequence[str]) -> list[str]:
    """`controller=FILE` as `run=FILE`: what is flown may be a run directory or a file of `nsde export`."""
    return [f"run={w.partition('=')[2]}" if w.startswith("controller=") else w for w in words]
