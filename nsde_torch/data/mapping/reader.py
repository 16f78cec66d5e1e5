"""Logs of whichever format, by the names of the files, and through a mapping: given, beside the logs, or proposed.

A proposal is used where nothing is missing or open in it and its checks pass; else the error says what to run. A
mapping that kinematics or gravity contradict is refused.
"""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

from nsde_torch.data.csv_folder import fits
from nsde_torch.data.formats.log import StreamLog
from nsde_torch.data.mapping.apply import apply
from nsde_torch.data.mapping.checks import checks
from nsde_torch.data.mapping.files import log_files, mapping_beside
from nsde_torch.data.mapping.mapping import LogMapping, read_mapping
from nsde_torch.data.mapping.proposal import full_of_all, propose
from nsde_torch.data.places import log_place
from nsde_torch.data.raw import Finding, RawRun
from nsde_torch.data.readers import READERS, kind_of, reader
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.errors import ConfigError, DataError


def format_of(path: str | Path, system: SystemInfo | None = None) -> str:
    """Kind of the logs in a file or folder; CSV with a mapping or without the system's columns is a table."""
    path = log_place(path, "a log or a folder of logs")
    kind = kind_of(path)
    if kind == "csv" and (path.is_file() or system is None or mapping_beside(path) or not fits(path, system)):
        return "table"
    return kind


def read_log(system: SystemInfo, *, path: str | Path, mapping: str | None = None) -> list[RawRun]:
    """Runs of a file or folder of logs.

    Args:
        mapping: What the columns mean, a YAML file; None: `mapping.yaml` beside the logs, else the proposal.

    Raises:
        DataError: as the reader of the format.
        ConfigError: a mapping for a format that needs none.
    """
    kind = "table" if mapping and kind_of(path) == "csv" else format_of(path, system)
    given: dict[str, Any] = {}
    if READERS[kind].streams:
        given["mapping"] = mapping
    elif mapping:
        raise ConfigError(f"`mapping`: data of kind {kind!r} are read without one.")
    runs: list[RawRun] = reader(kind)(system, path=path, **given)
    return runs


def read_mapped(
    system: SystemInfo, *, path: str | Path, kind: str, mapping: str | Path | LogMapping | None = None
) -> list[RawRun]:
    """Runs of a file or a folder of logs.

    Args:
        kind: Key of `READERS` of a reader of streams.
        mapping: What the columns mean, or its YAML file; None: `mapping.yaml` beside the logs, else the proposal.

    Raises:
        DataError: a log that cannot be read, one that needs a mapping, or one that contradicts it.
        ConfigError: a mapping that does not fit the logs or the system.
    """
    files = log_files(kind, path)
    beside = mapping_beside(path) if mapping is None else None
    given = mapping if isinstance(mapping, LogMapping) else None
    if given is None and (mapping or beside):
        given = read_mapping(str(mapping or beside))
    runs: list[RawRun] = []
    proposed = given is None
    for file in files:
        log = file.open(given.time if given else None)
        if given is None:
            given = full_of_all(_proposed(log, system, kind, path), files)
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
