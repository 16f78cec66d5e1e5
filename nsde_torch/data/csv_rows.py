"""Rows of a small CSV file that a person wrote, as text by column."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from nsde_torch.errors import DataError


def csv_rows(path: Path, needed: Sequence[str], *, what: str, remedy: str) -> list[dict[str, str]]:
    """The rows of a CSV file with a header.

    Args:
        path: The file.
        needed: Columns that it must have.
        what: What the file is, for messages.
        remedy: What to do where it cannot be read.

    Raises:
        DataError: the file or a column is missing.
    """
    if path.exists() and not path.is_file():
        raise DataError(f"{what} {path} is no regular file. {remedy}")
    try:
        with path.open(encoding="utf-8", newline="") as opened:
            rows = list(csv.DictReader(opened))
    except OSError as error:
        raise DataError(f"{what} {path}: {error.strerror}. {remedy}") from error
    have = list(rows[0]) if rows else []
    missing = [name for name in needed if name not in have]
    if missing:
        raise DataError(
            f"{what} {path} has no column {', '.join(missing)}; it has: {', '.join(have) or 'none'}."
        )
    return rows
