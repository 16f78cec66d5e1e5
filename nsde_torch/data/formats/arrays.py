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
    """Arrays of a .mat file, structures flattened with dots; cells, objects and functions are left out.

    Raises:
        DataError: not such a file, or too large.
    """
    from scipy.io import loadmat, whosmat

    with path.open("rb") as file:
        head = file.read(128)
    if b"MATLAB 7.3" in head or head.startswith(b"\x89HDF"):
        return {name: value.T for name, value in read_hdf5(path).items() if not name.startswith("#")}
    try:
        known = whosmat(str(path))
        wanted = [n for n, _, kind in known if kind not in ("object", "opaque", "function", "cell", "char")]
        refuse_larger(path, 8 * sum(int(np.prod(shape)) for n, shape, _ in known if n in wanted))
        raw = loadmat(str(path), variable_names=wanted) if wanted else {}
    except DataError:
        raise
    except Exception as error:  # as above
        raise unreadable(path, ".mat file", error) from error
    return dict(_flat({k: v for k, v in raw.items() if not k.startswith("__")}))


def _flat(values: Mapping[str, Any], before: str = "", depth: int = 0) -> Iterator[tuple[str, NDArray[Any]]]:
    for key, value in values.items():
        name, array = before + key, np.asarray(value)
        if array.dtype.names and array.size == 1 and depth < _DEPTH:
            one = array.reshape(-1)[0]
            yield from _flat({n: one[n] for n in array.dtype.names}, f"{name}.", depth + 1)
        elif array.dtype.kind in "fiub":
            yield name, array


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
