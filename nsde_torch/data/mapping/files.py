"""The runs in a file or a folder, by kind: one log one run, but for tables that are streams of one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nsde_torch.data.formats.betaflight import logs_of
from nsde_torch.data.formats.log import ClockOf, StreamLog
from nsde_torch.data.formats.table import TEXT, are_runs
from nsde_torch.data.places import entries, files_of, log_place
from nsde_torch.data.readers import READERS
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.lookup import function_by_name

MAPPING_FILE = "mapping.yaml"
"""Name of the mapping beside the logs, which is read where none is given."""


@dataclass(frozen=True)
class LogFile:
    """One run that can be opened."""

    name: str  # of the run
    path: Path  # file or folder
    kind: str  # its reader
    index: int = 1  # which log of the file, from 1

    def open(self, clock: ClockOf | None = None) -> StreamLog:
        """The streams; tables are told how they give the time, other formats say so themselves."""
        given: dict[str, Any] = {"clock": clock} if self.kind == "table" else {}
        if self.kind == "betaflight":
            given["index"] = self.index
        log: StreamLog = function_by_name(str(READERS[self.kind].streams), kind="reader")(self.path, **given)
        log.name = self.name
        return log


def log_files(kind: str, path: str | Path) -> list[LogFile]:
    """The runs of a file or folder, in the order of their names; a DataError where there is none of that kind."""
    path = Path(path)
    if kind not in READERS or READERS[kind].streams is None:
        raise ConfigError(f"data of kind {kind!r} are read without a mapping.")
    suffixes = tuple(dict.fromkeys((*READERS[kind].suffixes, *(TEXT if kind == "table" else ()))))
    log_place(path, f"a file ({', '.join(suffixes)}) or a folder of them")
    files = [path] if path.is_file() or _is_bag(path) else _inside(path, suffixes, kind)
    if not files:
        held = ", ".join(p.name for p in entries(path)[:5]) or "nothing"
        raise DataError(
            f"`path`: {path} holds no file of the kind {kind!r} ({', '.join(suffixes)}); it holds {held}."
        )
    if kind == "betaflight":
        return [
            LogFile(file.stem if count == 1 else f"{file.stem}_{k}", file, kind, k)
            for file in files
            for count in [logs_of(file)]
            for k in range(1, count + 1)
        ]
    return [LogFile(file.stem, file, kind) for file in files]


def _is_bag(path: Path) -> bool:
    return path.is_dir() and (path / "metadata.yaml").is_file() and bool(list(path.glob("*.db3")))


def _inside(folder: Path, suffixes: Sequence[str], kind: str) -> list[Path]:
    found = entries(folder)
    folders = [p for p in found if p.is_dir()]
    if kind == "rosbag":
        files = [p for p in found if p.is_file() and p.suffix.lower() in suffixes]
        return files + [p for p in folders if _is_bag(p)]
    files = files_of(folder, suffixes)
    if kind != "table":
        return files
    text = [p for p in files if p.suffix.lower() in TEXT]
    if len(text) > 1 and len(text) == len(files) and not are_runs(text):
        return [folder]  # streams of one run
    if not files:
        return [p for p in folders if any(q.suffix.lower() in suffixes for q in p.iterdir())]
    return files


def mapping_beside(path: str | Path) -> Path | None:
    """The mapping file that lies with the logs; None where there is none."""
    path = Path(path)
    file = (path if path.is_dir() else path.parent) / MAPPING_FILE
    return file if file.is_file() else None
