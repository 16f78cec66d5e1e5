"""Tables as text: comma, semicolon, tab or spaces between columns, comments, a header row or numbers of columns.

What is no number in a column of numbers is missing; a column of words is left out; one of lists is a column for each
place in them.
"""

from __future__ import annotations

import csv
import re
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.formats.clock import UNNAMED
from nsde_torch.data.formats.log import unreadable
from nsde_torch.data.places import LONGEST, NOTHING, check_names, count_rows, refuse_larger
from nsde_torch.errors import DataError

_MARKS = (",", ";", "\t")
_COMMENT = ("#", "%")
_PROBED = 200  # rows that tell which columns hold numbers
_BRACKETS = re.compile(r"[\[(][^\[\]()]*[\])]")
_BARE_LIST = {mark: re.compile(rf"(?:^|(?<={mark}))\s*{_BRACKETS.pattern}") for mark in (*_MARKS, " ")}
_ARRAY = re.compile(r"^(?:np\.|numpy\.)?array\(|,?\s*dtype=[\w.]+")
_DECIMAL = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")


@dataclass(frozen=True)
class _Layout:
    """What stands where: the names, the mark between cells, and how many lines precede the rows."""

    names: list[str]
    mark: str
    before: int
    unnamed: bool


def header(path: Path) -> list[str]:
    """Names of the columns; of a table without a header their numbers.

    Raises:
        DataError: no text, or nothing in it.
    """
    return _layout(path).names


def read_text(path: Path, notes: list[str] | None = None) -> dict[str, Array]:
    """Columns of numbers by name; an empty cell is nan, a column of words is left out.

    Args:
        path: The file.
        notes: Takes what was assumed, and what is missing because it is no number.

    Raises:
        DataError: no text, no numbers, or rows of another width (with the line).
    """
    notes = [] if notes is None else notes
    layout = _layout(path)
    names, mark = layout.names, layout.mark
    check_names(names, f"{path}:{layout.before}")
    lines = count_rows(path)  # before any of them is read: none is too long to be one
    rows = [_cells(line, mark) for _, line in islice(_rows(path, layout.before), _PROBED)]
    if not rows:
        raise DataError(f"{path} has a header and no rows.")
    widths = {k: _width([r[k] for r in rows if k < len(r)], mark) for k, name in enumerate(names) if name}
    use = {k: width for k, width in widths.items() if width >= 0}
    if not any(
        _number(r[k], mark) is not None or width for r in rows for k, width in use.items() if k < len(r)
    ):
        raise DataError(f"{path}: no column holds numbers.")
    refuse_larger(path, 8.0 * lines * sum(max(width, 1) for width in use.values()))
    if layout.unnamed:
        notes.append(f"no header: columns are called by their numbers, {names[0]} to {names[-1]}")
    columns = None if any(use.values()) else _at_once(path, layout, list(use))
    if columns is None:
        columns = _cell_by_cell(path, layout, use, notes)
    return columns


def _layout(path: Path) -> _Layout:
    """The header: the first row, a comment of as many cells before rows of numbers, or none."""
    comments: list[tuple[int, str]] = []
    rows: list[tuple[int, str]] = []
    try:
        with path.open(encoding="utf-8-sig", errors="strict", newline="") as file:
            for number in range(1, 1 << 20):
                line = file.readline(LONGEST)
                if "\x00" in line or len(line) >= LONGEST:
                    raise unreadable(path, "table of text", "a line is no text")
                if not line or len(rows) == 2:
                    break
                if line.lstrip().startswith(_COMMENT):
                    if not rows:
                        comments.append((number, line))
                elif line.strip():
                    rows.append((number, line))
    except UnicodeDecodeError as error:
        raise unreadable(path, "table of text", "it is not UTF-8 text") from error
    if not rows:
        if not comments:
            raise unreadable(path, "table of text", "no header row")
        raise DataError(f"{path} has a header and no rows.")
    number, first = rows[0]
    mark = _mark(first)
    cells = _cells(first, mark)
    below = _cells(rows[1][1], mark) if len(rows) == 2 else cells
    pairs = list(zip(cells, below, strict=False))
    counted = [_is_numeric(a, mark) or a in NOTHING for a, b in pairs if _is_numeric(b, mark)]
    if not (all(counted) and any(_is_numeric(cell, mark) for cell in cells)):
        return _Layout(cells, mark, number, False)
    for _, line in reversed(comments):  # the one nearest to the rows that has a name for each column
        text = line.strip().lstrip("#% ")
        names = _cells(text, _mark(text))
        if len(names) == len(cells) and not any(_number(name, mark) is not None for name in names):
            return _Layout(names, mark, number - 1, False)
    return _Layout([f"{UNNAMED}{k + 1}" for k in range(len(cells))], mark, number - 1, True)


def _mark(line: str) -> str:
    plain = _BRACKETS.sub("", re.sub(r'"[^"]*"', "", line))
    mark = max(_MARKS, key=plain.count)
    return mark if mark in plain else " "


def _rows(path: Path, before: int) -> Iterator[tuple[int, str]]:
    """The lines of the table with their numbers: without what is empty or a comment."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            for number, line in enumerate(file, start=1):
                if number > before and line.strip() and not line.lstrip().startswith(_COMMENT):
                    yield number, line.rstrip("\r\n")
    except UnicodeDecodeError as error:
        raise unreadable(path, "table of text", "it is not UTF-8 text") from error


def _at_once(path: Path, layout: _Layout, use: list[int]) -> dict[str, Array] | None:
    """All columns by NumPy, in a tenth of the time; None where a cell is neither a number nor empty."""
    mark = layout.mark
    try:
        table = np.loadtxt(
            _filled(path, layout),
            delimiter=None if mark == " " else mark,
            usecols=use,
            ndmin=2,
            comments=None,
            quotechar='"',
        )
    except ValueError:
        return None
    return {layout.names[k]: np.ascontiguousarray(table[:, j]) for j, k in enumerate(use)}


def _filled(path: Path, layout: _Layout) -> Iterator[str]:
    """Rows of numbers, empty cells as nan."""
    mark = layout.mark
    hole, filled = mark + mark, f"{mark}nan{mark}"
    for number, row in _rows(path, layout.before):
        if mark != " ":
            if '"' not in row:
                _same_width(path, number, row.count(mark) + 1, layout)
            while hole in row:
                row = row.replace(hole, filled)
            if row.startswith(mark):
                row = "nan" + row
            if row.endswith(mark):
                row += "nan"
        yield row


def _same_width(path: Path, number: int, cells: int, layout: _Layout) -> None:
    if cells != len(layout.names):
        reason = f"line {number} has {cells} cells, the header {len(layout.names)}: it may be cut short"
        raise unreadable(path, "table of numbers", reason)


def _cell_by_cell(path: Path, layout: _Layout, use: dict[int, int], notes: list[str]) -> dict[str, Array]:
    """Columns of numbers among which there are words, and of lists."""
    read = {k: array("d") for k in use}  # a list of floats would take four times the memory
    words: dict[int, list[str]] = {k: [] for k in use}
    for number, row in _rows(path, layout.before):
        cells = _cells(row, layout.mark)
        _same_width(path, number, len(cells), layout)
        for k, width in use.items():
            one = _number(cells[k], layout.mark)
            values = (_list(cells[k]) or []) if width else [] if one is None else [one]
            if len(values) != max(width, 1):
                if cells[k] not in NOTHING:
                    words[k].append(f"{cells[k][:40]!r} in line {number}")
                values = [float("nan")] * max(width, 1)
            read[k].extend(values)
    out: dict[str, Array] = {}
    for k, width in use.items():
        name, table = layout.names[k], np.array(read[k]).reshape(-1, max(width, 1)).T
        if words[k]:
            what = f"no list of {width} numbers" if width else "no number"
            count, first = len(words[k]), words[k][0]
            notes.append(f"cells of {name!r} that are {what} are missing: {count}, the first {first}")
        out.update({f"{name}[{j}]": table[j] for j in range(width)} if width else {name: table[0]})
    return out


def _cells(line: str, mark: str) -> list[str]:
    line = line.strip() if mark == " " else line.rstrip("\r\n")
    if '"' not in line and ("[" in line or "(" in line):
        line = _BARE_LIST[mark].sub(r'"\g<0>"', line)
    if '"' in line:
        parts = next(csv.reader([line], delimiter=mark, skipinitialspace=True))
    else:
        parts = line.split() if mark == " " else line.split(mark)
    return [part.strip().strip('"').strip() for part in parts]


def _width(cells: list[str], mark: str) -> int:
    """What most cells of a column hold: 0 of numbers, the length of lists, -1 of words."""
    lists = [len(one) for cell in cells if _number(cell, mark) is None and (one := _list(cell)) is not None]
    numbers = sum(_number(cell, mark) is not None for cell in cells)
    words = sum(cell not in NOTHING for cell in cells) - numbers - len(lists)
    if lists and len(lists) > max(words, numbers):
        return max(set(lists), key=lists.count)
    return 0 if numbers > words + len(lists) or not words + len(lists) else -1


def _number(cell: str, mark: str) -> float | None:
    """The number in a cell, with a decimal comma where no comma separates columns."""
    try:
        return float(cell.replace(",", ".") if mark != "," and _DECIMAL.fullmatch(cell) else cell)
    except ValueError:
        return None


def _list(cell: str) -> list[float] | None:
    """The numbers of a list in a cell; three or more need no brackets."""
    text = _ARRAY.sub(" ", cell).strip()
    parts = re.split(r"[,;\s]+", re.sub(r"[\[\](){}]", " ", text).strip())
    if text[:1] not in ("[", "(", "{") and len(parts) < 3:
        return None
    try:
        return [float(part) for part in parts]
    except ValueError:
        return None


def _is_numeric(cell: str, mark: str) -> bool:
    return _number(cell, mark) is not None or _list(cell) is not None
