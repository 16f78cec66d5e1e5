"""The files of a diagnosis: `diagnosis.json`, `effects.yaml`, `report.html` and `plots/`."""

from __future__ import annotations

import re
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, final

from nsde_torch.effects import files as effects_files
from nsde_torch.whole_files import json_text, write_whole

if TYPE_CHECKING:
    from nsde_torch.diagnosis.result import Content, Diagnosis

_REPORTS = 0.05  # share of the time that reports so far may take
_REPORT_S = 5.0  # what the first of them takes about [s]
RESULT, EFFECTS, REPORT, PLOTS = "diagnosis.json", "effects.yaml", "report.html", "plots"


def picture_file(name: str) -> str:
    """Name of the file of a picture: without what a law has and a file should not."""
    return re.sub(r"[^\w\[\].-]+", "_", name).strip("_") + ".png"


def write_content(content: Content, folder: Path) -> None:
    """Write `diagnosis.json`."""
    write_whole(folder / RESULT, json_text(content))


def write_effects(found: Diagnosis, folder: Path, *, system: str, note: str) -> None:
    """Write `effects.yaml` for a system; `note` is its first line, after that the diagnosis is not finished."""
    note = f"so far, not finished: {note}" if found.so_far is not None else note
    if found.of_runs:
        note += f"\n# not in this file, as it says nothing of other runs: {', '.join(found.of_runs)}"
    effects_files.write(folder / EFFECTS, system, found.effects, note)


@final
class DiagnosisFiles:
    """Keeps the files of a diagnosis up to date while it goes on."""

    def __init__(self, folder: Path, *, system: str, note: str) -> None:
        self._folder, self._system, self._note = folder, system, note
        self._began, self._spent, self._next = perf_counter(), 0.0, _REPORT_S

    def write_so_far(self, found: Diagnosis) -> None:
        """Write what is known so far; the report too, where that takes little of the time so far.

        That report is without the log over time, which is 5 MB with its script.
        """
        now = perf_counter()
        if self._spent + self._next < _REPORTS * (now - self._began):
            self.write(found, over_time=False)
            self._next = perf_counter() - now
            self._spent += self._next
        else:
            self._write(found)

    def write(self, found: Diagnosis, *, over_time: bool = True) -> Content:
        """Write everything, the log over time if it is asked for; returns the content of `diagnosis.json`."""
        from nsde_torch.diagnosis.report import write_report

        content = self._write(found)
        write_report(self._folder / REPORT, found, content, over_time=over_time)
        return content

    def _write(self, found: Diagnosis) -> Content:
        content = found.content()
        write_content(content, self._folder)
        write_effects(found, self._folder, system=self._system, note=self._note)
        return content
