"""Arrays by name in a file: NumPy's .npz, MATLAB's .mat, HDF5, Parquet. Numbers alone: no pickles, objects or links."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data.formats.log import lacking, unreadable
from nsde_torch.data.places import refuse_larger
from nsde_torch.errors import DataError

_DEPTH = 8  # of groups and structures
_MOST = 20_000  # arrays in a file
_ELEMENTS = 256  # of a cell or an array of structures
Arrays = dict[str, NDArray[Any]]


def read_npz(path: Path) -> Arrays:
    """Arrays of an .npz file; one of objects is left out, as nothing is unpickled.

    Raises:
        DataError: not such a file, or too large.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(item.file_size for item in archive.infolist())
        refuse_larger(path, size)
        out: Arrays = {}
        with np.load(path, allow_pickle=False) as file:
            for name in file.files[:_MOST]:
                try:
                    out[name] = file[name]
                except ValueError as error:
                    if "pickle" not in str(error):
                        raise
    except DataError:
        raise
    except Exception as error:  # a damaged archive makes the parser raise nearly anything
        raise unreadable(path, ".npz file", error) from error
    return out


def read_mat(path: Path) -> Arrays:
    """Arrays of a .mat file, structures and cells flattened with dots; Simulink's signals by their labels.

    Raises:
        DataError: not such a file, too large, or of objects alone.
    """
    from scipy.io import loadmat, whosmat

    with path.open("rb") as file:
        head = file.read(128)
    if b"MATLAB 7.3" in head or head.startswith(b"\x89HDF"):
        return {name: value.T for name, value in read_hdf5(path).items() if not name.startswith("#")}
    try:
        known = whosmat(str(path))
        wanted = [n for n, _, kind in known if kind not in ("object", "opaque", "function", "char")]
        refuse_larger(path, 8 * sum(int(np.prod(shape)) for n, shape, _ in known if n in wanted))
        raw = loadmat(str(path), variable_names=wanted) if wanted else {}
    except DataError:
        raise
    except Exception as error:  # as above
        raise unreadable(path, ".mat file", error) from error
    objects = [n for n, _, kind in known if kind in ("object", "opaque")]
    if objects and not wanted:
        raise DataError(
            f"{path} holds objects alone ({', '.join(objects)}: timeseries or Datasets, say), which only MATLAB "
            "reads: log as `Structure With Time`, or save `struct('time', x.Time, 'q', x.Data)`."
        )
    return {
        name: a for key, value in raw.items() if key[:2] != "__" for name, a in _flat(key, np.asarray(value))
    }


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
    """Data sets of an HDF5 file by their paths with dots; what lies in other files is not followed.

    Raises:
        DataError: not such a file, too large, or it asks for other files.
        ConfigError: the package is not installed.
    """
    try:
        import h5py
    except ImportError as error:
        raise lacking("h5py", "tables", path) from error
    out: Arrays = {}
    size = 0

    def visit(group: Any, before: str, depth: int) -> None:
        nonlocal size
        for key in group:
            link = group.get(key, getlink=True)
            if not isinstance(
                link, h5py.HardLink
            ):  # soft links may lead in circles, external ones to other files
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

    try:
        with h5py.File(path, "r") as file:
            visit(file, "", 0)
    except DataError:
        raise
    except Exception as error:  # as above
        raise unreadable(path, "HDF5 file", error) from error
    return out


def read_parquet(path: Path) -> Arrays:
    """Columns of numbers and of times of a Parquet file.

    Raises:
        DataError: not such a file, or too large.
        ConfigError: the package is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet as parquet
    except ImportError as error:
        raise lacking("pyarrow", "tables", path) from error
    out: Arrays = {}
    try:
        with parquet.ParquetFile(path, memory_map=True) as file:
            rows, schema = file.metadata.num_rows, file.schema_arrow
            kinds = pyarrow.types
            wanted = [
                f.name
                for f in schema
                if kinds.is_floating(f.type)
                or kinds.is_integer(f.type)
                or kinds.is_boolean(f.type)
                or kinds.is_timestamp(f.type)
            ]
            refuse_larger(path, 8 * rows * len(wanted))
            for name in wanted:  # one at a time: a table and its copy would be twice the memory
                column = file.read(columns=[name]).column(0)
                if kinds.is_timestamp(schema.field(name).type):
                    nanoseconds = column.cast(pyarrow.timestamp("ns")).to_numpy().astype(np.int64)
                    out[name] = nanoseconds.astype(np.float64) * 1e-9
                else:
                    out[name] = column.to_numpy().astype(np.float64)
    except DataError:
        raise
    except Exception as error:  # as above
        raise unreadable(path, "Parquet file", error) from error
    return out
