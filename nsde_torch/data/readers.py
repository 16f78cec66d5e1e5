"""The readers of data by kind: a file each, and a line here.

A reader is a function `read(system, *, path, ...)` that returns one `RawRun` for each continuous recording it finds:
times, states and inputs in SI units and in the system's order, missing values as nan. What is wrong with the numbers is
not its business: every data set passes the same checks afterwards. The table names where the function lies, so that
listing the kinds imports none of them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from nsde_torch.data.places import entries
from nsde_torch.errors import ConfigError
from nsde_torch.lookup import function_by_name


@dataclass(frozen=True)
class Reader:
    """One line of the table."""

    home: str  # where the function lies, `module:function`
    summary: str  # what it reads, one line
    suffixes: tuple[str, ...] = ()  # suffixes of files of this kind; none: those that no other reader claims
    folders: bool = True  # whether a folder with such a file in it is of the kind too
    takes_step: bool = False  # whether it must know the step to resample to, as the files hold no times
    streams: str | None = None
    """Function `open(path)` that opens one file as streams (`nsde_torch.data.formats.StreamLog`), of a format whose
    columns need a mapping; `home` is then that of all mappings."""
    mapped: bool = False  # whether it takes a mapping


def _log_format(streams: str, summary: str, *suffixes: str) -> Reader:
    home = "nsde_torch.data.mapping.reader:read_mapped"
    return Reader(home, summary, suffixes, streams=f"nsde_torch.data.formats.{streams}", mapped=True)


READERS: dict[str, Reader] = {
    "csv": Reader("nsde_torch.data.csv_folder:read_csv", "A folder with one CSV file per run."),
    "ulog": Reader("nsde_torch.data.ulog:read_ulog", "One PX4 log or a folder of them.", suffixes=(".ulg",)),
    "published": Reader(
        "nsde_torch.data.published:read_published",
        "The authors' published files.",
        suffixes=(".pkl", ".pickle"),
        folders=False,
        takes_step=True,
    ),
    "mcap": _log_format("ros:open_mcap", "MCAP files: topics of ROS 1, ROS 2 and JSON.", ".mcap"),
    "rosbag": _log_format("ros:open_rosbag", "Bags of ROS 1 (.bag) and ROS 2 (.db3).", ".bag", ".db3"),
    "ardupilot": _log_format("ardupilot:open_ardupilot", "ArduPilot's DataFlash logs.", ".bin"),
    "betaflight": _log_format("betaflight:open_betaflight", "Betaflight's black box logs.", ".bbl", ".bfl"),
    "table": _log_format(
        "table:open_table",
        "Tables with a mapping: CSV, .npz, .mat, HDF5, Parquet.",
        *(".npz", ".mat", ".h5", ".hdf5", ".hdf", ".parquet", ".pq", ".tsv", ".txt"),
    ),
    "log": Reader(
        "nsde_torch.data.mapping.reader:read_log",
        "Logs of any of these formats, by the names of the files.",
        mapped=True,
    ),
}

Kind: TypeAlias = str | Callable[..., Any]
"""A reader: a key of `READERS`, `package.module:function` of the user's own, or the function."""


def reader(kind: Kind) -> Callable[..., Any]:
    """The function that reads a kind of data; a ConfigError lists the choices, or says what is not there."""
    if not isinstance(kind, str):
        return kind
    if kind not in READERS and ":" not in kind:
        raise ConfigError(
            f"`kind` of data must be one of {', '.join(sorted(READERS))}; got {kind!r}. (Simulated data come from "
            "`nsde_torch.simulation`; a reader of your own is `module:function`.)"
        )
    if kind in READERS and READERS[kind].streams:
        return partial(function_by_name(READERS[kind].home, kind="reader"), kind=kind)
    return function_by_name(READERS[kind].home if kind in READERS else kind, kind="reader")


def name_of(kind: Kind) -> str:
    """A reader in words, for summaries."""
    return kind if isinstance(kind, str) else f"{kind.__module__}:{getattr(kind, '__qualname__', kind)}"


def kind_of(path: str | Path) -> str:
    """Kind of the data in a file or folder, by the names of the files; csv where nothing says otherwise."""
    file = Path(path)
    held = entries(file) if file.is_dir() else []
    if held and all(p.is_dir() for p in held):  # a folder for each run
        held = [p for folder in held for p in entries(folder)]
    inside = {p.suffix.lower() for p in held}
    for kind, known in READERS.items():
        if {file.suffix.lower()} & set(known.suffixes) or (known.folders and inside & set(known.suffixes)):
            return kind
    return "csv"
