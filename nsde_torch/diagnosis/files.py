"""The files of a diagnosis: `diagnosis.json`, `effects.yaml`, `report.html` and `plots/`."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nsde_torch.effects import files as effects_files

if TYPE_CHECKING:
    from nsde_torch.diagnosis.result import Diagnosis

RESULT, EFFECTS, REPORT, PLOTS = "diagnosis.json", "effects.yaml", "report.html", "plots"


def picture_file(name: str) -> str:
    """Name of the file of a picture: without what a law has and a file should not."""
    return re.sub(r"[^\w\[\].-]+", "_", name).strip("_") + ".png"


def write_content(content: Mapping[str, Any], folder: Path) -> None:
    """Write `diagnosis.json`."""
    (folder / RESULT).write_text(json.dumps(content, indent=1, allow_nan=False), encoding="utf-8")


def write_effects(found: Diagnosis, folder: Path, *, system: str, note: str) -> None:
    """Write `effects.yaml`.

    Args:
        found: The diagnosis.
        folder: Where to.
        system: Name of the system that takes the file.
        note: First line.
    """
    effects_files.write(folder / EFFECTS, system, found.effects, note)


def save(found: Diagnosis, folder: str | Path) -> Path:
    """Write all files of a diagnosis (`Diagnosis.save`)."""
    from nsde_torch.diagnosis.report import write_report

    folder, content = Path(folder), found.content()
    folder.mkdir(parents=True, exist_ok=True)
    write_content(content, folder)
    write_effects(found, folder, system=found.system_name, note="found by nsde_torch.diagnose")
    write_report(folder / REPORT, found, content)
    return folder / REPORT
