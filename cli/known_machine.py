"""What the files of a diagnosis say about a machine: its system, the runs that were looked at, and what was found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nsde_torch.data import DataSet, Run
from nsde_torch.diagnosis.files import EFFECTS
from nsde_torch.effects import files as effects_files
from nsde_torch.systems import System


@dataclass(frozen=True)
class KnownMachine:
    """A machine after a diagnosis."""

    system: System  # declared system
    runs: Sequence[Run]  # runs that were looked at
    clock: float  # physical seconds per logged second
    values: Mapping[str, Any]  # effects that were found, with values


def known_machine(folder: Path, content: Mapping[str, Any], system: System, data: DataSet) -> KnownMachine:
    """What a diagnosis knows: `content` is that of its `diagnosis.json`."""
    names = set(content["data"]["runs"])
    return KnownMachine(
        system,
        [run for run in data.runs if run.name in names],
        float(content["data"].get("clock_scale") or 1.0),
        effects_files.read(folder / EFFECTS)[1] if (folder / EFFECTS).is_file() else {},
    )


def faults_of_sensors(content: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Faults of the recording chain that a diagnosis found, with the values of their parameters."""
    return {
        finding["name"]: {
            label.partition(".")[2]: parameter["value"]
            for label, parameter in content["parameters"].items()
            if label.startswith(f"{finding['name']}.")
        }
        for finding in content["findings"]
        if finding["kind"] == "recording"
    }
