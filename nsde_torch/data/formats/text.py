"""Tables as text: comma, semicolon, tab or spaces between columns, a header row, what is no number left out."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data.formats.log import unreadable
from nsde_torch.data.places import LONGEST, count_rows, refuse_larger
from nsde_torch.errors import DataError

Array = NDArray[np.float64]

_MARKS = (",", ";", "\t")
_PROBED = 200  # rows that tell which columns hold numbers
_NOTHING = {"", "nan", "NaN", "NAN", "null", "None", "NA", "N/A", "-"}


def read_text(path: Path) -> dict[str, Array]:
    """Columns of numbers by name; an empty cell is nan, a column of words is left out.

    Raises:
        DataError: no text, no header, rows of another width, or a cell that is no number (with its line).
    """
    try:
        with path.open(encoding="utf-8-sig", errors="strict", newline="") as file:
            head = file.readline(LONGEST)
            while head.startswith("%"):  # comments before the header
                head = file.readline(LONGEST)
            probe = [line for _ in range(_PROBED) if (line := file.readline(LONGEST)).strip()]
    except UnicodeDecodeError as error:
        raise unreadable(path, "table of text", "it is not UTF-8 text") from error
    if "\x00" in head or len(head) >= LONGEST or not head.strip():
        raise unreadable(path, "table of text", "no header row")
    mark = max(_MARKS, key=head.count)
    if mark not in head:
        mark = " "
    names = _cells(head.lstrip("#"), mark)
    if all(_number(name) for name in names):
        raise DataError(f"{path}:1: the first row holds numbers; expected a header row with names.")
    if len(set(names)) < len(names):
        twice = sorted({n for n in names if names.count(n) > 1})
        raise DataError(f"{path}:1: the columns {twice} occur more than once; keep one of each.")
    rows = [_cells(line, mark) for line in probe]
    if not rows:
        raise DataError(f"{path} has a header and no rows.")
    use = [
        k
        for k, name in enumerate(names)
        if name and any(k < len(r) and _number(r[k]) for r in rows) and not any(_word(r, k) for r in rows)
    ]
    if not use:
        raise DataError(f"{path}: no column holds numbers.")
    refuse_larger(path, 8.0 * count_rows(path) * len(use))
    try:
        table = np.loadtxt(
            _lines(path, mark, len(names)),
            delimiter=None if mark == " " else mark,
            usecols=use,
            ndmin=2,
            comments=None,
            quotechar='"',
        )
    except (ValueError, UnicodeDecodeError) as error:
        raise unreadable(path, "table of numbers", error) from error
    return {names[k]: np.ascontiguousarray(table[:, j]) for j, k in enumerate(use)}


def _lines(path: Path, mark: str, width: int) -> Iterator[str]:
    """Rows of numbers, empty cells as nan."""
    hole, filled = mark + mark, f"{mark}nan{mark}"
    with path.open(encoding="utf-8-sig", newline="") as file:
        number = 1
        while file.readline(LONGEST).startswith("%"):
            number += 1
        for line in file:
            number += 1
            row = line.rstrip("\r\n")
            if not row.strip():
                continue
            if mark != " ":
                if row.count(mark) != width - 1 and '"' not in row:
                    raise ValueError(
                        f"line {number} has {row.count(mark) + 1} cells, the header {width}: it may be cut short"
                    )
                while hole in row:
                    row = row.replace(hole, filled)
                if row.startswith(mark):
                    row = "nan" + row
                if row.endswith(mark):
                    row += "nan"
            yield row


def _cells(line: str, mark: str) -> list[str]:
    parts = line.split() if mark == " " else line.rstrip("\r\n").split(mark)
    return [part.strip().strip('"').strip() for part in parts]


def _number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _word(row: list[str], k: int) -> bool:
    return k < len(row) and row[k] not in _NOTHING and not _number(row[k])
