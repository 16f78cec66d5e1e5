"""Logs of whichever format, by the names of the files, and through a mapping: given, beside the logs, or proposed.

One log is one run, but for tables that are streams of one. A proposal is used where nothing is missing or open in it
and its checks pass; else the error says what to run. A mapping that kinematics or gravity contradict is refused.
"""

import shlex
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.csv_folder import fits
from nsde_torch.data.formats.betaflight import logs_of
from nsde_torch.data.formats.table import TEXT, are_runs
from nsde_torch.data.mapping.apply import apply
from nsde_torch.data.mapping.checks import checks
from nsde_torch.data.mapping.mapping import ColumnEntry, LogMapping, read_mapping
from nsde_torch.data.mapping.proposal import in_unit, propose
from nsde_torch.data.places import entries, files_of, log_place
from nsde_torch.data.raw import Finding, RawRun
from nsde_torch.data.readers import READERS, kind_of, reader
from nsde_torch.data.streams import ClockOf, StreamLog
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.lookup import function_by_name

MAPPING_FILE = "mapping.yaml"  # name of the mapping beside the logs, which is read where none is given


@dataclass(frozen=True)
class LogFile:
    """One run that can be opened."""

    name: str  # of the run
    path: Path  # file or folder
    kind: str  # its reader
    index: int = 1  # which log of the file, from 1

    def open(self, clock: ClockOf | None = None) -> StreamLog:
        """The streams; a table needs `clock` for its time, other formats have it themselves."""
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


def format_of(path: str | Path, system: SystemInfo | None = None) -> str:
    """Kind of the logs in a file or folder; CSV with a mapping or without the system's columns is a table."""
    path = log_place(path, "a log or a folder of logs")
    kind = kind_of(path)
    if kind == "csv" and (path.is_file() or system is None or mapping_beside(path) or not fits(path, system)):
        return "table"
    return kind


def read_log(system: SystemInfo, *, path: str | Path, mapping: str | None = None) -> list[RawRun]:
    """Runs of a file or folder of logs.

    What the columns mean is said by a YAML file; None: `mapping.yaml` beside the logs, else the proposal. A ConfigError
    refuses a mapping for a format that needs none.
    """
    kind = "table" if mapping and kind_of(path) == "csv" else format_of(path, system)
    given: dict[str, Any] = {}
    if READERS[kind].streams:
        given["mapping"] = mapping
    elif mapping:
        raise ConfigError(f"`mapping`: data of kind {kind!r} are read without one.")
    runs: list[RawRun] = reader(kind)(system, path=path, **given)
    return runs


def scaled_by_all(mapping: LogMapping, log: StreamLog, files: Sequence[LogFile]) -> LogMapping:
    """A mapping proposed from the first log, with ends of the motors' range that hold in all, if the log says none.

    What lies beyond the ends is refused. Speeds of rotors of one flight can pass for pulses in microseconds
    (Neural-Fly in the strongest wind, 1027 to 1675; in less wind 592 to 1357).
    """
    entry = mapping.columns.get("u")
    if entry is None or "u" in log.columns or (entry.full is None and entry.unit != "us"):
        return mapping
    values = _inputs(log, entry)
    for file in files[1:]:
        with suppress(DataError):  # said where it is read
            values += _inputs(file.open(mapping.time), entry)
    whole = replace(entry, low=None, high=None, full=None)
    read = in_unit(whole, np.concatenate(values), None if entry.unit == "us" else entry.unit)
    return mapping.changed("u", unit=read.unit, low=read.low, high=read.high, full=read.full)


def _inputs(log: StreamLog, entry: ColumnEntry) -> list[Array]:
    found = [log.find(source) for source in entry.source if log.has(source)]
    return [stream.fields[column] for stream, column in found]


def read_mapped(
    system: SystemInfo, *, path: str | Path, kind: str, mapping: str | Path | LogMapping | None = None
) -> list[RawRun]:
    """Runs of a file or a folder of logs, of a kind of `READERS` that reads streams.

    What the columns mean is said by a mapping or its YAML file; None: `mapping.yaml` beside the logs, else the
    proposal. A DataError refuses a log that cannot be read, needs a mapping, or contradicts it; a ConfigError a mapping
    that does not fit the logs or the system.
    """
    files = log_files(kind, path)
    mapping = mapping or mapping_beside(path)
    given = read_mapping(mapping) if isinstance(mapping, str | Path) else mapping
    runs: list[RawRun] = []
    proposed = given is None
    for file in files:
        log = file.open(given.time if given else None)
        if given is None:
            given = scaled_by_all(_proposed(log, system, kind, path), log, files)
        run = apply(log, given, system)
        del log
        for check in checks(system, run, given):
            if check.passed is False:
                raise DataError(
                    f"run {run.name!r}: the mapping contradicts the log: {check.text} To mend it: {check.remedy}; "
                    f"`{_inspection(path, system)}` proposes another mapping."
                )
        if proposed:
            text = "the mapping was proposed, and passed its checks"
            run.notes.append(Finding("proposed_mapping", run.name, 1, text, "reported"))
        runs.append(run)
    return runs


def _inspection(path: str | Path, system: SystemInfo) -> str:
    return f"nsde inspect {shlex.quote(str(path))} system={system.name}"


def _proposed(log: StreamLog, system: SystemInfo, kind: str, path: str | Path) -> LogMapping:
    found = propose(log, system, kind=kind)
    command = _inspection(path, system)
    if found.mapping is None or found.missing:
        raise DataError(
            f"{log.source}: by their names, no columns are {', '.join(found.missing) or 'of the machine'}, which the "
            f"system {system.name!r} needs. Run `{command}`, which lists what is inside, and write the mapping, or "
            "choose a system of what was logged."
        )
    if found.open:
        raise DataError(
            f"{log.source}: {'; '.join(found.open)}. Run `{command}`, which proposes a mapping, checks and writes it."
        )
    return found.mapping
