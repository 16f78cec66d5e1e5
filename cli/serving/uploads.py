"""What the page accepts: files with the suffix of a log, named anew, as large as they were said to be."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from nsde_torch.data.readers import READERS

from .refused import RefusedError

_PICKLES = READERS["published"].suffixes
_ARCHIVES = (".zip", ".gz", ".tgz", ".tar", ".7z", ".rar", ".xz", ".bz2", ".zst")
_LONGEST = 60  # letters of a name
_PIECE = 1 << 18  # bytes read at a time
FORMATS: dict[str, str] = {
    ".csv": "table",
    **{s: kind for kind, one in READERS.items() if kind != "published" for s in one.suffixes},
}
"""Suffix -> reader of the logs that are accepted; pickles are not among them."""


def file_names(given: Sequence[str]) -> list[str]:
    """Names for the files of an upload, made of letters, digits, `_` and `-`, and a known suffix.

    Args:
        given: As the browser says them; nothing of them is taken for a path.

    Raises:
        RefusedError: one is no log, or they are logs of several formats.
    """
    out: list[str] = []
    kinds: dict[str, str] = {}
    for name in given:
        last = re.split(r"[/\\]", name)[-1]
        stem, dot, suffix = last.rpartition(".")
        suffix = f".{suffix.lower()}" if dot else ""
        if suffix not in FORMATS:
            raise RefusedError(_no_log(shown(last), suffix), 415)
        kinds.setdefault(FORMATS[suffix], shown(last))
        plain = re.sub(r"[^A-Za-z0-9_-]+", "_", stem).strip("_")[:_LONGEST] or "log"
        k, free = 1, plain
        while f"{free}{suffix}".lower() in (n.lower() for n in out):
            k += 1
            free = f"{plain}_{k}"
        out.append(f"{free}{suffix}")
    if len(kinds) > 1:
        raise RefusedError(
            f"These are logs of different formats ({', '.join(kinds.values())}): drop those of one format at a time.",
            415,
        )
    return out


def shown(name: str) -> str:
    """A name as a sentence may show it."""
    printable = "".join(c for c in name if c.isprintable())
    return printable if len(printable) <= _LONGEST else f"{printable[:_LONGEST]}..."


def _no_log(name: str, suffix: str) -> str:
    if suffix in _ARCHIVES:
        return f"{name} is an archive, which is not opened here: unpack it and drop the logs that are in it."
    if suffix in _PICKLES:
        return f"{name} is a pickle, which may hold a program and is not loaded: write its arrays as .npz or CSV."
    return f"{name} is no log that is known here: expected one of {', '.join(FORMATS)}."


def receive(read: Callable[[int], bytes], target: Path, size: int) -> None:
    """Write what is sent to a file, and stop where it is longer than was said.

    Args:
        read: Reads at most so many bytes of what is sent; empty at its end.
        target: The file; nothing is left of it if the upload fails.
        size: Bytes that were announced.

    Raises:
        RefusedError: more or fewer bytes came.
    """
    part = target.with_name(f"{target.name}.part")
    count = 0
    try:
        with part.open("wb") as file:
            while piece := read(_PIECE):
                count += len(piece)
                if count > size:
                    raise RefusedError(
                        f"{target.name} is longer than the {size} bytes that were announced.", 413
                    )
                file.write(piece)
        if count < size:
            raise RefusedError(
                f"Of {target.name} {count} of {size} bytes arrived: the upload was cut off; drop it again."
            )
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)
