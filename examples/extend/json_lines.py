"""A reader: logs with one JSON object a line, in units of their own.

{"time_us": 0, "position_mm": 12.3, "speed_mm_s": 0.4, "motor_mv": 20.0}
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from nsde_torch.data import RawRun, SystemInfo
from nsde_torch.errors import DataError

COLUMNS = {
    "p": ("position_mm", 1e-3),
    "p_dot": ("speed_mm_s", 1e-3),
    "voltage": ("motor_mv", 1e-3),
}
"""Name in the system -> name in the log, and what its numbers are multiplied with."""


def read_json_lines(system: SystemInfo, *, path: str | Path, pattern: str = "*.jsonl") -> list[RawRun]:
    """All runs of a folder, one file each.

    Args:
        system: The system whose states and inputs are wanted.
        path: The folder.
        pattern: Which files of the folder are logs.

    Raises:
        DataError: no file, or a line without one of the columns.
    """
    files = sorted(Path(path).glob(pattern))
    if not files:
        raise DataError(f"{path} holds no {pattern}.")
    return [_run(system, file) for file in files]


def _run(system: SystemInfo, file: Path) -> RawRun:
    lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]

    def columns(names: tuple[str, ...]) -> Any:
        table = []
        for name in names:
            logged, factor = COLUMNS[name]
            if any(logged not in line for line in lines):
                raise DataError(f"{file}: a line has no {logged!r}.")
            table.append([factor * line[logged] for line in lines])
        return np.array(table, dtype=np.float64).T

    t = np.array([1e-6 * line["time_us"] for line in lines])
    return RawRun(file.stem, t, columns(system.state_names), columns(system.input_names), source=str(file))
