"""Runs of logs of any format through a mapping: the one that is given, the one beside the logs, or the proposal.

A proposal is used where nothing is missing or open in it and its checks pass; else the error says what to run. A
mapping that kinematics or gravity contradict is refused.
"""

from __future__ import annotations

import shlex
from pathlib import Path

from nsde_torch.data.formats.log import StreamLog
from nsde_torch.data.mapping.apply import apply
from nsde_torch.data.mapping.checks import checks
from nsde_torch.data.mapping.files import log_files, mapping_beside
from nsde_torch.data.mapping.inputs import full_of_all
from nsde_torch.data.mapping.mapping import LogMapping, read_mapping
from nsde_torch.data.mapping.proposal import propose
from nsde_torch.data.raw import Finding, RawRun
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.errors import DataError


def read_mapped(
    system: SystemInfo, *, path: str | Path, kind: str, mapping: str | Path | LogMapping | None = None
) -> list[RawRun]:
    """Runs of a file or a folder of logs.

    Args:
        system: The machine.
        path: File or folder.
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
    assumed = ""
    for file in files:
        log = file.open(given.time if given else None)
        if given is None:
            given = full_of_all(_proposed(log, system, kind, path), files)
            assumed = "the mapping was proposed, and passed its checks"
        run = apply(log, given, system)
        del log
        _refuse_contradicted(system, run, given, _inspection(path, system))
        if assumed:
            run.notes.append(Finding("proposed_mapping", run.name, 1, assumed, "reported"))
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


def _refuse_contradicted(system: SystemInfo, run: RawRun, mapping: LogMapping, command: str) -> None:
    for check in checks(system, run, mapping):
        if check.passed is False:
            raise DataError(
                f"run {run.name!r}: the mapping contradicts the log: {check.text} To mend it: {check.remedy}; "
                f"`{command}` proposes another mapping."
            )
