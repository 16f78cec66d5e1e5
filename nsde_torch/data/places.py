"""Files of logs as they lie on a disk: there, regular, and not filled up with zeros; said before any is opened.

A pipe would make a reader wait for ever, and a file of holes (a copy or a recording that was cut short) makes a parser
take its whole length for a line or for messages.
"""

import stat
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path

from nsde_torch.errors import DataError

LARGEST = 1 << 30  # most bytes that the numbers of one file may fill
LONGEST = 1 << 20  # most characters of a line of text
WIDEST = 10_000  # most columns of a table
NOTHING = {"", "nan", "NaN", "NAN", "null", "None", "NA", "N/A", "n/a", "-"}
"""Cells of a table of text whose value is missing."""
_HOLE = 1 << 24  # bytes of zeros at the end of a file; those of a preallocated log are fewer


def log_place(path: str | Path, expected: str) -> Path:
    """A file or folder of logs, which is there, can be read, is not empty and ends with no zeros; else a DataError."""
    path = Path(path)
    try:
        found = path.stat()
    except FileNotFoundError:
        raise DataError(f"`path`: {path} does not exist; expected {expected}.") from None
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise DataError(f"`path`: {path} cannot be opened ({why}); expected {expected}.") from None
    if stat.S_ISREG(found.st_mode):
        if not found.st_size:
            raise DataError(
                f"{path} is empty: a recording that never began, or a copy that failed. Leave it out."
            )
        if found.st_size >= _HOLE:
            with path.open("rb") as file:
                file.seek(found.st_size - _HOLE)
                if not file.read(_HOLE).strip(b"\x00"):
                    raise DataError(
                        f"{path} ends with {_HOLE >> 20} MiB of zeros or more: a copy or recording that was cut short. "
                        "Copy it again, or cut the zeros off."
                    )
    elif not stat.S_ISDIR(found.st_mode):
        raise DataError(f"`path`: {path} is no regular file (a pipe, socket or device); expected {expected}.")
    return path


def entries(folder: Path) -> list[Path]:
    """What a folder holds and does not hide, by name; a DataError where it cannot be read."""
    try:
        return sorted(p for p in folder.iterdir() if not p.name.startswith("."))
    except OSError as error:
        raise DataError(f"`path`: {folder} cannot be read ({error.strerror}).") from None


def files_of(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """Files of a folder with one of these suffixes; a DataError where one is no regular file, or holds zeros."""
    found = [p for p in entries(folder) if p.suffix.lower() in suffixes]
    for path in found:
        log_place(path, "a log")
        if path.is_dir():
            raise DataError(f"{path} is a folder with the name of a log; rename it or move it away.")
    return found


def count_rows(path: Path) -> int:
    """Lines of a file of text; a DataError where a byte is no text, or a line is too long to be one."""
    rows = 0
    with path.open("rb") as file:
        while piece := file.read(LONGEST):
            ends = piece.count(b"\n")
            if b"\x00" in piece:
                raise DataError(
                    f"{path} holds bytes of zero after line {rows + 1}: no text, or a copy that was cut short. Copy it "
                    "again, or save it as CSV in UTF-8."
                )
            if not ends and len(piece) == LONGEST:
                raise DataError(f"{path}:{rows + 1}: the line is longer than {LONGEST} bytes: no table.")
            rows += ends
    return rows


def check_names(names: Sequence[str], place: str) -> None:
    """Refuse a header (at a `place`, file and line) with too many columns, or with one name for two of them."""
    if len(names) > WIDEST:
        raise DataError(
            f"{place}: the table has {len(names)} columns; at most {WIDEST} are read. Keep those of the machine."
        )
    twice = sorted(name for name, count in Counter(names).items() if count > 1)
    if twice:
        raise DataError(f"{place}: the columns {twice} occur more than once; keep one of each.")


def refuse_larger(path: Path, size: float) -> None:
    """Refuse numbers that fill more bytes than `LARGEST`."""
    if size > LARGEST:
        raise DataError(
            f"{path} holds {size / 2**30:.3g} GiB of numbers; at most {LARGEST >> 30} are read at once. Split it, or "
            "keep fewer columns or rows."
        )
