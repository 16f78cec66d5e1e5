"""Tables: CSV and other text, .npz, .mat, HDF5 and Parquet, each file one run, or a folder of streams one run.

Arrays of one length belong to one clock: that of a time column of the same length (in the same group, where there are
groups). An array (n, k) has the columns `name[0]` to `name[k-1]`; one alone in its file has numbers,
`column_1` and so on.
"""

import csv
import re
import zipfile
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nsde_torch.arrays import Array
from nsde_torch.data.places import LONGEST, NOTHING, check_names, count_rows, files_of, refuse_larger
from nsde_torch.data.streams import (
    UNNAMED,
    ClockOf,
    StreamLog,
    found,
    from_date,
    optional,
    parsing,
    time_column,
    timed,
    unreadable,
)
from nsde_torch.errors import DataError

_DEPTH = 8  # of groups and structures
_MOST = 20_000  # arrays in a file
_ELEMENTS = 256  # of a cell or an array of structures
Arrays = dict[str, NDArray[Any]]


def read_npz(path: Path) -> Arrays:
    """Arrays of an .npz file; one of objects is left out, as nothing is unpickled."""
    out: Arrays = {}
    with parsing(path, ".npz file"):
        with zipfile.ZipFile(path) as archive:
            refuse_larger(path, sum(item.file_size for item in archive.infolist()))
        with np.load(path, allow_pickle=False) as file:
            for name in file.files[:_MOST]:
                try:
                    out[name] = file[name]
                except ValueError as error:
                    if "pickle" not in str(error):
                        raise
    return out


def read_mat(path: Path) -> Arrays:
    """Arrays of a .mat file, structures and cells flattened with dots; Simulink's signals by their labels."""
    from scipy.io import loadmat, whosmat

    with path.open("rb") as file:
        head = file.read(128)
    if b"MATLAB 7.3" in head or head.startswith(b"\x89HDF"):
        return {name: value.T for name, value in read_hdf5(path).items() if not name.startswith("#")}
    with parsing(path, ".mat file"):
        known = whosmat(str(path))
        wanted = [n for n, _, kind in known if kind not in ("object", "opaque", "function", "char")]
        refuse_larger(path, 8 * sum(int(np.prod(shape)) for n, shape, _ in known if n in wanted))
        raw = loadmat(str(path), variable_names=wanted) if wanted else {}
    objects = [n for n, _, kind in known if kind in ("object", "opaque")]
    if objects and not wanted:
        raise DataError(
            f"{path} holds objects alone ({', '.join(objects)}: timeseries or Datasets, say), which only MATLAB "
            "reads: log as `Structure With Time`, or save `struct('time', x.Time, 'q', x.Data)`."
        )
    return {name: a for key, v in raw.items() if key[:2] != "__" for name, a in _flat(key, np.asarray(v))}


def _flat(name: str, value: NDArray[Any], depth: int = 0) -> Iterator[tuple[str, NDArray[Any]]]:
    """Arrays in a variable; an element of several has its number in its name."""
    if value.dtype.kind in "fiub":
        yield name, value
    elif (value.dtype.names or value.dtype.kind == "O") and depth < _DEPTH and value.size <= _ELEMENTS:
        for k, part in enumerate(value.reshape(-1)):
            own = f"{name}_{k + 1}" if value.size > 1 else name
            if not value.dtype.names:  # a cell
                yield from _flat(own, np.asarray(part), depth + 1)
                continue
            fields = {key: np.asarray(part[key]) for key in value.dtype.names}
            signals = _simulink(own, fields)
            if signals:
                yield from signals
                continue
            label = _label(fields)
            for key, inside in fields.items():  # an element of a Dataset is called by its name
                called = label if label and key.lower() == "values" else key
                yield from _flat(f"{own}.{called}", inside, depth + 1)


def _simulink(name: str, fields: Mapping[str, NDArray[Any]]) -> list[tuple[str, NDArray[Any]]]:
    """Signals with their clock: of a structure with time, or of a timeseries as a structure; of anything else none."""
    own = {key.lower(): value for key, value in fields.items()}
    times = own.get("time", np.zeros(0))
    signals = own.get("signals", np.zeros(0)).reshape(-1)
    keys = signals.dtype.names or ()
    if "values" in keys:
        found = [({key: np.asarray(one[key]) for key in keys}, one["values"]) for one in signals]
    elif "data" in own and times.size > 1:
        found = [(dict(fields), own["data"])]
    else:
        return []
    out = [(f"{name}.time", times)] if times.size > 1 else []
    for k, (said, values) in enumerate(found):
        values = np.asarray(values)
        if values.ndim == 3:  # (k, 1, n): one sample after another
            values = values.reshape(-1, values.shape[2]).T
        label = _label(said) or name.rpartition(".")[2] + (f"_{k + 1}" if len(found) > 1 else "")
        if values.dtype.kind in "fiub":
            out.append((f"{name}.{label}", values))
    return out


def _label(fields: Mapping[str, NDArray[Any]]) -> str:
    """What Simulink calls a signal; empty where it has no name."""
    for key in ("label", "Name", "name"):
        if key in fields and fields[key].dtype.kind == "U" and fields[key].size:
            return str(fields[key].reshape(-1)[0]).strip("<> ").replace(".", "_")
    return ""


def read_hdf5(path: Path) -> Arrays:
    """Data sets of an HDF5 file by their paths with dots; what lies in other files is not followed."""
    h5py = optional("h5py", "tables", path)
    out: Arrays = {}
    size = 0

    def visit(group: Any, before: str, depth: int) -> None:
        nonlocal size
        for key in group:
            # soft links may lead in circles, external ones to other files
            if not isinstance(group.get(key, getlink=True), h5py.HardLink):
                continue
            item = group[key]
            if isinstance(item, h5py.Group):
                if depth < _DEPTH:
                    visit(item, f"{before}{key}.", depth + 1)
                continue
            if item.dtype.kind not in "fiubV" or len(out) >= _MOST:
                continue
            if item.external or item.is_virtual:
                raise DataError(
                    f"{path}: the data of {before}{key} lie in another file, which is not opened."
                )
            size += item.size * max(item.dtype.itemsize, 8)
            refuse_larger(path, size)
            value = item[()]
            if value.dtype.names:  # a table of records: a column each
                for field in value.dtype.names:
                    if value.dtype[field].kind in "fiub":
                        out[f"{before}{key}.{field}"] = value[field]
            else:
                out[before + key] = np.asarray(value)

    with parsing(path, "HDF5 file"), h5py.File(path, "r") as file:
        visit(file, "", 0)
    return out


def read_parquet(path: Path) -> Arrays:
    """Columns of numbers and of times of a Parquet file."""
    pyarrow, parquet = (optional(name, "tables", path) for name in ("pyarrow", "pyarrow.parquet"))
    out: Arrays = {}
    with parsing(path, "Parquet file"), parquet.ParquetFile(path, memory_map=True) as file:
        kinds, schema = pyarrow.types, file.schema_arrow
        moments = (kinds.is_timestamp, kinds.is_duration)
        numbers = (kinds.is_floating, kinds.is_integer, kinds.is_boolean, *moments)
        wanted = [f.name for f in schema if any(is_one(f.type) for is_one in numbers)]
        refuse_larger(path, 8 * file.metadata.num_rows * len(wanted))
        for name in wanted:  # one at a time: a table and its copy would be twice the memory
            column = file.read(columns=[name]).column(0)
            kind = schema.field(name).type
            if any(is_one(kind) for is_one in moments):
                whole = pyarrow.duration("ns") if kinds.is_duration(kind) else pyarrow.timestamp("ns")
                nanoseconds = column.cast(whole).to_numpy().astype(np.int64)
                out[name] = nanoseconds.astype(np.float64) * 1e-9
            else:
                out[name] = column.to_numpy().astype(np.float64)
    return out


# Tables as text: comma, semicolon, tab or spaces between columns, comments, a header row or numbers of
# columns.
#
# What is no number in a column of numbers is missing; a column of words is left out; one of lists is a column
# for each place in them.

_MARKS = (",", ";", "\t")
_COMMENT = ("#", "%")
_PROBED = 200  # rows that decide which columns hold numbers
_BRACKETS = re.compile(r"[\[(][^\[\]()]*[\])]")
_BARE_LIST = {mark: re.compile(rf"(?:^|(?<={mark}))\s*{_BRACKETS.pattern}") for mark in (*_MARKS, " ")}
_ARRAY = re.compile(r"^(?:np\.|numpy\.)?array\(|,?\s*dtype=[\w.]+")
_DECIMAL = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")


@dataclass(frozen=True)
class _Layout:
    """What stands where in a table."""

    names: list[str]
    mark: str  # between cells
    before: int  # lines that precede the rows


def read_text(path: Path, notes: list[str]) -> dict[str, Array]:
    """Columns of numbers by name; an empty cell is nan, a column of words is left out.

    `notes` takes what was assumed, and what is missing because it is no number.
    """
    layout = _layout(path, notes)
    names, mark = layout.names, layout.mark
    check_names(names, f"{path}:{layout.before}")
    lines = count_rows(path)  # before any of them is read: none is too long to be one
    rows = [_cells(line, mark) for _, line in islice(_rows(path, layout.before), _PROBED)]
    if not rows:
        raise DataError(f"{path} has a header and no rows.")
    widths = {k: _width([r[k] for r in rows if k < len(r)], mark) for k, name in enumerate(names) if name}
    use = {k: width for k, width in widths.items() if width >= 0}
    if not any(_number(r[k], mark) is not None or w for r in rows for k, w in use.items() if k < len(r)):
        raise DataError(f"{path}: no column holds numbers.")
    refuse_larger(path, 8.0 * lines * sum(max(width, 1) for width in use.values()))
    columns = None if any(use.values()) else _at_once(path, layout, list(use))
    return _cell_by_cell(path, layout, use, notes) if columns is None else columns


def _layout(path: Path, notes: list[str]) -> _Layout:
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
        return _Layout(cells, mark, number)
    for _, line in reversed(comments):  # the one nearest to the rows that has a name for each column
        text = line.strip().lstrip("#% ")
        names = _cells(text, _mark(text))
        if len(names) == len(cells) and not any(_number(name, mark) is not None for name in names):
            return _Layout(names, mark, number - 1)
    names = [f"{UNNAMED}{k + 1}" for k in range(len(cells))]
    notes.append(f"no header: columns are called by their numbers, {names[0]} to {names[-1]}")
    return _Layout(names, mark, number - 1)


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
    """The number in a cell, with a decimal comma where no comma separates columns; of a date its seconds."""
    try:
        return float(cell.replace(",", ".") if mark != "," and _DECIMAL.fullmatch(cell) else cell)
    except ValueError:
        return from_date(cell)


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


TEXT = (".csv", ".tsv", ".txt")
_READ = {".npz": read_npz, ".mat": read_mat, **dict.fromkeys((".h5", ".hdf5", ".hdf"), read_hdf5)}
_READ |= dict.fromkeys((".parquet", ".pq"), read_parquet)
_WIDEST = 64  # columns of one array


def open_table(path: Path, *, clock: ClockOf | None = None) -> StreamLog:
    """The streams of one file, or of a folder whose files are streams of one run; a clock not given is found."""
    clock = clock or ClockOf()
    notes: list[str] = []
    if path.is_dir():
        tables = {
            f"{file.stem}/{name}".rstrip("/"): one
            for file in files_of(path, (*TEXT, *_READ))
            for name, one in _columns(file, notes).items()
        }
    else:
        tables = _columns(path, notes)
    streams = [timed(name, fields, clock, notes, source=str(path)) for name, fields in tables.items()]
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
    groups = {name: name.rpartition(".")[0] for name in arrays}
    clocks = {(groups[n], _length(v)) for n, v in arrays.items() if time_column([n.rpartition(".")[2]])}
    lengths = {length for _, length in clocks if length > 1}
    out: dict[tuple[str, int], dict[str, Array]] = {}
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


def _length(value: NDArray[Any]) -> int:
    return max(value.shape, default=0) if value.ndim <= 2 and value.size == max(value.shape, default=0) else 0


def _upright(value: NDArray[Any], lengths: set[int]) -> NDArray[Any] | None:
    """A table (rows, columns); one that lies on its side is turned. None for anything that is no table."""
    if value.ndim == 1:
        value = value[:, None]
    if value.ndim != 2 or value.dtype.kind not in "fiub" or max(value.shape) < 2 or not value.size:
        return None
    sideways = value.shape[0] < value.shape[1]
    if (value.shape[1] in lengths and value.shape[0] not in lengths) or (
        sideways and value.shape[0] not in lengths and value.shape[0] <= _WIDEST
    ):
        value = value.T
    return value if value.shape[1] <= _WIDEST else None


def are_runs(files: list[Path]) -> bool:
    """Whether files of text are a run each, and not streams of one run.

    Runs have one header, or share most columns where a recorder logged more in some of them (experiments of a DC motor:
    `t, u, y` and `t, r, y, u`). Streams measure different things under names of their own.
    """
    headers = [set(_layout(file, []).names) for file in files]
    return len(set.intersection(*headers)) / max(map(len, headers)) > 0.5
