"""Logs of whichever format, by the names of the files: `data=log`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nsde_torch.data.csv_folder import fits
from nsde_torch.data.mapping.files import mapping_beside
from nsde_torch.data.places import log_place
from nsde_torch.data.raw import RawRun
from nsde_torch.data.readers import kind_of, reader
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.errors import ConfigError


def format_of(path: str | Path, system: SystemInfo | None = None) -> str:
    """Kind of the logs in a file or folder; CSV with a mapping or without the system's columns is a table.

    Args:
        path: File or folder.
        system: The machine; None: no columns are asked for.

    Raises:
        DataError: nothing there.
    """
    path = log_place(path, "a log or a folder of logs")
    kind = kind_of(path)
    if kind == "csv" and (path.is_file() or system is None or mapping_beside(path) or not fits(path, system)):
        return "table"
    return kind


def read_log(system: SystemInfo, *, path: str | Path, mapping: str | None = None) -> list[RawRun]:
    """Runs of a file or folder of logs.

    Args:
        system: The machine.
        path: File or folder.
        mapping: What the columns mean, a YAML file; None: `mapping.yaml` beside the logs, else the proposal.

    Raises:
        DataError: as the reader of the format.
        ConfigError: a mapping for a format that needs none.
    """
    from nsde_torch.data.readers import READERS

    kind = "table" if mapping and kind_of(path) == "csv" else format_of(path, system)
    given: dict[str, Any] = {}
    if READERS[kind].streams:
        given["mapping"] = mapping
    elif mapping:
        raise ConfigError(f"`mapping`: data of kind {kind!r} are read without one.")
    runs: list[RawRun] = reader(kind)(system, path=path, **given)
    return runs
