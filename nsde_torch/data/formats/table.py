"""Tables: CSV and other text, .npz, .mat, HDF5 and Parquet, each file one run, or a folder of streams one run.

Arrays of one length belong to one clock: that of a time column of the same length (in the same group, where there are
groups). An array (n, k) has the columns `name[0]` to `name[k-1]`; one alone in its file has numbers,
`column_1` and so on.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nsde_torch.arrays import Array
from nsde_torch.data.formats.arrays import Arrays, read_hdf5, read_mat, read_npz, read_parquet
from nsde_torch.data.formats.clock import UNNAMED, ClockOf, found, time_column, timed
from nsde_torch.data.formats.log import StreamLog
from nsde_torch.data.formats.text import header, read_text
from nsde_torch.data.places import files_of
from nsde_torch.errors import DataError

TEXT = (".csv", ".tsv", ".txt")
_READ = {
    ".npz": read_npz,
    ".mat": read_mat,
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
    ".hdf": read_hdf5,
    ".parquet": read_parquet,
    ".pq": read_parquet,
}
_WIDEST = 64  # columns of one array


def open_table(path: Path, *, clock: ClockOf | None = None) -> StreamLog:
    """The streams of one file, or of a folder whose files are streams of one run.

    Args:
        path: The file or folder.
        clock: How the tables tell the time; None: by names.

    Raises:
        DataError: a file that cannot be read, or one without a table of numbers.
        ConfigError: a package is not installed, or the clock is not there.
    """
    clock = clock or ClockOf()
    notes: list[str] = []
    if path.is_dir():
        files = files_of(path, (*TEXT, *_READ))
        tables = {
            f"{file.stem}/{name}".rstrip("/"): one
            for file in files
            for name, one in _columns(file, notes).items()
        }
    else:
        tables = _columns(path, notes)
    streams = [timed(name, fields, clock, source=str(path)) for name, fields in tables.items()]
    if not streams:
        raise DataError(f"{path} holds no table of numbers with two rows or more.")
    clocks = [found(fields, clock) for fields in tables.values()]
    one = clocks[0] if len(set(clocks)) == 1 else None
    return StreamLog(path.stem, str(path), streams, notes=notes, clock=one)


def _columns(path: Path, notes: list[str]) -> dict[str, dict[str, Array]]:
    """The tables of a file by name."""
    if path.suffix.lower() not in _READ:
        return {"": read_text(path, notes)}
    arrays = _READ[path.suffix.lower()](path)
    tables = _tables(arrays)
    if len(arrays) == 1 and len(tables) == 1:
        (fields,) = tables.values()
        if len(fields) > 1:  # one array without names, as a block To File or a single `save` writes it
            notes.append(f"one array, {next(iter(arrays))}: its columns are called by their numbers")
            return {"": {f"{UNNAMED}{k + 1}": values for k, values in enumerate(fields.values())}}
    groups = [group for group, _ in tables]
    out: dict[str, dict[str, Array]] = {}
    for (group, rows), fields in tables.items():
        name = group if len(tables) > 1 else ""
        if groups.count(group) > 1:  # arrays of several lengths side by side
            name = f"{name}/{rows} rows".lstrip("/")
        out[name] = fields
    return out


def _tables(arrays: Arrays) -> dict[tuple[str, int], dict[str, Array]]:
    """Columns that share a clock, by their group and length."""
    lengths = [
        length
        for name, value in arrays.items()
        if (length := _rows(value)) > 1 and time_column([_last(name)])
    ]
    out: dict[tuple[str, int], dict[str, Array]] = {}
    groups = {name: name.rpartition(".")[0] for name in arrays}
    clocks = {(groups[n], _rows(v)) for n, v in arrays.items() if time_column([_last(n)])}
    for name, value in arrays.items():
        table = _upright(value, lengths)
        if table is None:
            continue
        group = groups[name]
        while group and (group, len(table)) not in clocks:
            group = group.rpartition(".")[0]  # the clock of a group serves those inside
        own = name[len(group) :].lstrip(".") if group else name
        columns = {own: table[:, 0]}
        if table.shape[1] > 1:
            columns = {f"{own}[{k}]": table[:, k] for k in range(table.shape[1])}
        target = out.setdefault((group, len(table)), {})
        target.update({key: np.asarray(v, dtype=np.float64) for key, v in columns.items()})
    return out


def _last(name: str) -> str:
    return name.rpartition(".")[2]


def _rows(value: NDArray[Any]) -> int:
    return max(value.shape, default=0) if value.ndim <= 2 and value.size == max(value.shape, default=0) else 0


def _upright(value: NDArray[Any], lengths: list[int]) -> NDArray[Any] | None:
    """A table (rows, columns); one that lies on its side is turned. None of scalars and of what is no table."""
    if value.ndim == 1:
        value = value[:, None]
    if value.ndim != 2 or value.dtype.kind not in "fiub" or max(value.shape) < 2:
        return None
    sideways = value.shape[0] < value.shape[1]
    if (value.shape[1] in lengths and value.shape[0] not in lengths) or (
        sideways and value.shape[0] not in lengths and value.shape[0] <= _WIDEST
    ):
        value = value.T
    return value if value.shape[1] <= _WIDEST else None


def are_runs(files: list[Path]) -> bool:
    """Whether files of text are a run each, and not streams of one run.

    Runs have one header; where a recorder logged more in some of them, most columns are shared and the names of the
    files differ by their numbers alone. Streams measure different things under names of their own.
    """
    headers = [set(header(file)) for file in files]
    alike = len({re.sub(r"\d+", "", file.stem) for file in files}) == 1
    shared = len(set.intersection(*headers)) / max(map(len, headers))
    return all(one == headers[0] for one in headers) or (alike and shared > 0.5)
