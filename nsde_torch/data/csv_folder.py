"""CSV data sets: a folder, one file a run, header row, SI, `t` on one clock, empty or `nan` = missing."""

import csv
import difflib
import shlex
from array import array
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data import places
from nsde_torch.data.places import LONGEST, NOTHING, files_of, log_place
from nsde_torch.data.raw import RawRun, run_of
from nsde_torch.data.run import DataSet
from nsde_torch.data.streams import from_date
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.errors import DataError


def csv_rows(path: Path, needed: Sequence[str], *, what: str, remedy: str) -> list[dict[str, str]]:
    """The rows of a CSV file with a header; a DataError says `what` file or column is missing, and the `remedy`."""
    if path.exists() and not path.is_file():
        raise DataError(f"{what} {path} is no regular file. {remedy}")
    try:
        with path.open(encoding="utf-8", newline="") as opened:
            rows = list(csv.DictReader(opened))
    except OSError as error:
        raise DataError(f"{what} {path}: {error.strerror}. {remedy}") from error
    if not rows:
        raise DataError(f"{what} {path} has no rows below a header. {remedy}")
    have = list(rows[0])
    missing = [name for name in needed if name not in have]
    if missing:
        raise DataError(f"{what} {path} has no column {', '.join(missing)}; it has: {', '.join(have)}.")
    return rows


TIME = "t"


def _needed(system: SystemInfo) -> tuple[str, ...]:
    return (TIME, *system.state_names, *system.input_names, *system.exogenous)


def _header(path: Path, system: SystemInfo) -> list[str]:
    """Column names of a file; what is missing or wrong is named with the nearest names at hand."""
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        line = file.readline(LONGEST)
    if not line.strip():
        raise DataError(f"{path} is empty; expected a header row with `t` and the state and input names.")
    if "\x00" in line:
        raise DataError(f"{path}: the first line is not text. Expected a CSV file with a header row.")
    names = [cell.strip().strip('"') for cell in line.rstrip("\r\n").split(",")]
    for mark, what in ((";", "semicolons"), ("\t", "tabs")):
        if len(names) == 1 and mark in line:
            raise DataError(
                f"{path}:1: columns are separated by {what}; expected commas (and a decimal point). "
                "Export the file again with commas."
            )
    if all(_is_number(name) for name in names):
        raise DataError(
            f"{path}:1: the first row holds numbers; expected a header row such as "
            f"`{','.join((TIME, *system.state_names, *system.input_names))}`."
        )
    if len(line) >= LONGEST:
        raise DataError(f"{path}:1: the line is longer than {LONGEST} bytes: no header of a table.")
    if "" in names:
        raise DataError(f"{path}:1: column {names.index('') + 1} of the header has no name.")
    places.check_names(names, f"{path}:1")
    optional = (*system.optional_inputs, *_inferable(system, names))
    needed = _needed(system)
    missing = [n for n in needed if n not in names and n not in optional]
    if missing:
        free = {n.lower(): n for n in names if n not in needed}
        close = ((n, difflib.get_close_matches(n.lower(), list(free), n=1)) for n in missing)
        hint = "".join(f" is {free[spelt]!r} meant as {name!r}?" for name, found in close for spelt in found)
        raise DataError(
            f"{path}:1: the columns {missing} of the system {system.name!r} are missing.{hint} Expected "
            f"{list(needed)}; got {names}. Rename or add the columns, or read them through a mapping: "
            f"`nsde inspect {shlex.quote(str(path))} system={system.name}` proposes one."
        )
    return names


def _inferable(system: SystemInfo, names: Sequence[str]) -> list[str]:
    """Rates that a file may lack, since it has their positions; all of them or none."""
    if system.quaternion is not None:
        return []
    pairs = [(position, rate) for position, rate, _ in system.position_derivatives]
    known = _needed(system)
    free = [name.lower() for name in names if name not in known]
    lacking = [(position, rate) for position, rate in pairs if rate not in names]
    if any(p not in names or difflib.get_close_matches(r.lower(), free, n=1) for p, r in lacking):
        return []
    return [rate for _, rate in lacking]


def fits(path: Path, system: SystemInfo) -> bool:
    """Whether the files of a folder have the columns of a system, by the first of them."""
    try:
        files = files_of(path, (".csv",))
        return bool(files) and bool(_header(files[0], system))
    except DataError:
        return False


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _table(path: Path, names: Sequence[str], needed: Sequence[str]) -> Array:
    """The numbers of a file, (n, columns); an empty cell is missing."""
    places.refuse_larger(path, 8.0 * places.count_rows(path) * len(names))
    try:
        with path.open(encoding="utf-8-sig") as file:
            file.readline()
            if not any(line.strip() for line in file):
                raise DataError(f"{path} has a header and no rows; a run needs at least two rows.")
        table: Array | None = None
        with suppress(ValueError):  # empty cells, dates and words are rare: only then the slower way
            table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2, comments=None, encoding="utf-8-sig")
        return table if table is not None and table.shape[1] == len(names) else _by_cells(path, names, needed)
    except (UnicodeDecodeError, csv.Error) as error:
        raise DataError(
            f"{path} could not be read as a table of numbers; save it as CSV in UTF-8, one row of numbers a line."
        ) from error


def _by_cells(path: Path, names: Sequence[str], needed: Sequence[str]) -> Array:
    """The same cell by cell; of a column that the system does not need, words (a flight mode) are missing."""
    out = array("d")
    with path.open(encoding="utf-8-sig", newline="") as file:
        file.readline()
        rows = csv.reader(file)
        for row in rows:
            cells, place = [cell.strip() for cell in row], f"{path}:{rows.line_num + 1}"
            if len(cells) < 2 and not any(cells):
                continue
            if len(cells) != len(names):
                raise DataError(
                    f"{place}: the row has {len(cells)} cells, the header {len(names)}. The file may be cut short, or "
                    "a decimal comma splits a number."
                )
            for name, cell in zip(names, cells, strict=True):
                value = from_date(cell) if name == TIME else None
                if value is None and _is_number(cell):
                    value = float(cell)
                if value is None and name in needed and cell not in NOTHING:
                    raise DataError(f"{place}: column {name!r} holds {cell!r}; expected a number or `nan`.")
                out.append(np.nan if value is None else value)
    return np.array(out).reshape(-1, len(names))


def read_csv_file(path: str | Path, system: SystemInfo) -> RawRun:
    """One run from one CSV file (see the module's text for the format).

    A DataError names wrong columns, a cell that is no number (file:line and column), or fewer than two rows.
    """
    path = Path(path)
    names = _header(path, system)
    table = _table(path, names, _needed(system))
    if len(table) < 2:
        raise DataError(
            f"{path} has {len(table)} row; a run needs at least two. Remove the file or record longer."
        )
    infinite = np.isinf(table)
    if infinite.any():
        row, column = (int(i) for i in np.argwhere(infinite)[0])
        raise DataError(
            f"{path}:{row + 2}: column {names[column]!r} is infinite; write `nan` where a value is missing."
        )
    columns = dict(zip(names, table.T, strict=True))
    t = columns.pop(TIME).copy()
    return run_of(columns, t, system, name=path.stem, source=str(path), first_line=2)


def read_csv(system: SystemInfo, *, path: str | Path) -> list[RawRun]:
    """All runs of a folder of CSV files, in the order of their names; a DataError where there are none."""
    folder = Path(path)
    if folder.is_file():
        raise DataError(
            f"`path`: {folder} is a file; a CSV data set is a folder with one file for each run. Give the "
            f"folder, {folder.parent}."
        )
    log_place(folder, "a folder with one CSV file for each run")
    files = files_of(folder, (".csv",))
    if not files:
        held = [p.name for p in places.entries(folder)][:5]
        raise DataError(
            f"`path`: {folder} holds no .csv file (it holds {held or 'nothing'}); expected one for each run."
        )
    return [read_csv_file(file, system) for file in files]


def write_csv(dataset: DataSet, folder: str | Path) -> list[Path]:
    """Writes each run as `<name>.csv` with every digit, so that it is read back as the same numbers; returns the files.

    The folder is made where it is missing; files of the same names are replaced.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for run in dataset.runs:
        if Path(run.name).name != run.name:
            raise DataError(f"run name {run.name!r} cannot be a file name; rename the run.")
        extra = {k: v for k, v in run.extra.items() if k not in dataset.input_names}
        names = (TIME, *dataset.state_names, *dataset.input_names, *extra)
        file = folder / f"{run.name}.csv"
        write_table(file, names, (run.t, run.x, run.u, *extra.values()))
        files.append(file)
    return files


def write_table(file: Path, names: Sequence[str], columns: Sequence[Array]) -> None:
    """Write columns (n,) and tables of them (n, k) with every digit, below a header."""
    with file.open("w", encoding="utf-8", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(names)
        for first in range(0, len(columns[0]), 4096):  # in pieces: text is five times the size of the numbers
            writer.writerows(np.column_stack([c[first : first + 4096] for c in columns]).tolist())
