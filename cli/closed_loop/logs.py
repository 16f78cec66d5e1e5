"""The logs there are, as a diagnosis and a design read them.

All lie in one folder, and a diagnosis is of those that it names: a log that came later is no part of it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import nsde_torch
from nsde_torch.data import DataSet
from nsde_torch.diagnosis.files import EFFECTS, REPORT, RESULT, write_content, write_effects
from nsde_torch.diagnosis.report import write_report
from nsde_torch.diagnosis.text import lines
from nsde_torch.effects import files as effects_files
from nsde_torch.errors import DataError
from nsde_torch.recording.faults import remedies
from nsde_torch.systems.options import system_options

from ..known_machine import KnownMachine, faults_of_sensors, known_machine


def log_files(folder: Path, name: str = "") -> list[Path]:
    """Logs in a folder: files of any kind but our own records, those of `name` alone where one is given."""
    if not folder.is_dir():
        return []
    found = sorted(
        p for p in folder.iterdir() if p.is_file() and not p.name.startswith(".") and p.suffix != ".json"
    )
    return [p for p in found if not name or p.stem == name or p.stem.startswith(f"{name}_")]


def read_logs(
    folder: Path, system: str, kind: str | None, content: Mapping[str, Any] | None = None
) -> DataSet:
    """Read all logs of a kind; None chooses by their names. What a diagnosis found that sensors did is taken out."""
    kinds = sorted({p.suffix.lower() for p in log_files(folder)})
    if kind is None and len(kinds) > 1:
        raise DataError(
            f"{folder} holds logs of several kinds ({', '.join(kinds)}): keep those of one kind there."
        )
    known = {} if content is None else faults_of_sensors(content)
    faults: dict[str, Any] = {name: values for name, values in known.items() if name in remedies()}
    return nsde_torch.read(folder, system=system, kind=kind, **faults)


def machine_in(folder: Path, diagnosis: Path, system: str, kind: str | None) -> KnownMachine:
    """What a diagnosis in a folder knows, with the runs that it looked at."""
    content = diagnosis_content(diagnosis)
    data = read_logs(folder, system, kind, content)
    return known_machine(diagnosis, content, system_options(system).make(), data)


def diagnosis_content(folder: Path) -> dict[str, Any]:
    """Content of `diagnosis.json`."""
    return json.loads((folder / RESULT).read_text(encoding="utf-8"))


def diagnose_logs(
    folder: Path, out: Path, system: str, kind: str | None, *, settings: Mapping[str, Any]
) -> None:
    """Diagnose all logs, unless that is done, and write what a diagnosis writes; settings are those of `diagnose`."""
    if (out / RESULT).is_file():
        return
    out.mkdir(parents=True, exist_ok=True)
    data = read_logs(folder, system, kind)
    print(data.summary)
    found = nsde_torch.diagnose(data, system=system, **settings).finished()
    content = found.content()
    write_effects(found, out, system=system, note="found by nsde close-loop")
    write_report(out / REPORT, found, content)
    print()
    print("\n".join(lines(content)))
    # last, because it says that the stage is finished
    write_content(content, out)


def effects_found(diagnosis: Path) -> list[Any]:
    """Effects that a diagnosis found, with values."""
    _, effects = effects_files.read(diagnosis / EFFECTS)
    return [{name: given} for name, given in effects.items()]
