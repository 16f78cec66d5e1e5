"""Words as a user types them that Hydra's grammar wants otherwise.

Folders: quotes around the `=` and `,` in the folders of a sweep's jobs. Effects of one coordinate: the brackets of
`coulomb_friction[q2]` are escaped in values, and are a level of their own in keys.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence

_QUOTED = re.compile(r"('(?:[^'\\]|\\.)*'|\"(?:[^\"\\]|\\.)*\")")
_LAW = re.compile(r"([A-Za-z_]\w*)\[(\w+)\]")
_PLAIN = re.compile(r"[\w./:+@%~-]*|[\['\"$].*")


def quoted(word: str, keys: Collection[str]) -> str:
    """`KEY=DIR` with the quotes that DIR needs, for one of these keys; any other word as it is."""
    name, _, value = word.partition("=")
    if name not in keys or _PLAIN.fullmatch(value):
        return word
    escaped = value.replace("\\", "\\\\").replace("'", "\\'")
    return f"{name}='{escaped}'"


def coordinates_named(word: str) -> str:
    """`KEY=[law[q2]]` with the brackets of the coordinate escaped, `LAW[q2].NAME=1` with it as a level of its own."""
    if word.startswith("-"):
        return word
    key, equals, value = word.partition("=")
    outside = _QUOTED.split(value)  # what stands in quotes is left alone
    outside[::2] = [_LAW.sub(r"\1\\[\2\\]", part) for part in outside[::2]]
    return _LAW.sub(r"\1.\2", key) + equals + "".join(outside)


def from_file(words: Sequence[str]) -> list[str]:
    """`controller=FILE` as `run=FILE`: what is flown may be a run directory or a file of `nsde export`."""
    return [f"run={w.partition('=')[2]}" if w.startswith("controller=") else w for w in words]
