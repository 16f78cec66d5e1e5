"""A simulated data set as files: a folder of CSV files that does not say what is in them, and the truth beside it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from nsde_torch.data.raw import RawRun
from nsde_torch.errors import ConfigError
from nsde_torch.simulation.generate import Simulation


def write(
    made: Simulation, folder: str | Path, *, truth: str | Path | None = None, overwrite: bool = False
) -> list[Path]:
    """Write a data set, and its truth beside it.

    Args:
        made: What `simulate` made.
        folder: Folder of the CSV files; made where it is missing.
        truth: File of the truth, outside the folder; None: the folder's name with `.truth.json`.
        overwrite: Replace the CSV files of a folder that holds something, and the truth.

    Returns:
        The CSV files and the truth.

    Raises:
        ConfigError: the folder holds something, the truth exists or would lie in the folder.
    """
    folder, beside = Path(folder), truth_path(folder, truth)
    check_free(folder, beside, overwrite=overwrite)
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.csv"):
        old.unlink()
    files = [_write_run(made, run, folder / f"{run.name}.csv") for run in made.runs]
    beside.parent.mkdir(parents=True, exist_ok=True)
    content = {**made.truth, "files": [file.name for file in files]}
    beside.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return [*files, beside]


def truth_path(folder: str | Path, truth: str | Path | None = None) -> Path:
    """Where the truth of a data set is written: `truth`, or beside the folder."""
    folder = Path(folder)
    return folder.parent / f"{folder.name}.truth.json" if truth is None else Path(truth)


def check_free(folder: Path, truth: Path, *, overwrite: bool) -> None:
    """Refuse to write over what is there, or a truth into the folder of the data.

    Raises:
        ConfigError: says what is there and the remedy.
    """
    if truth.resolve().is_relative_to(folder.resolve()):
        raise ConfigError(f"`truth`: {truth} lies in the folder of the data; name a file outside {folder}.")
    if folder.is_file():
        raise ConfigError(f"`out`: {folder} is a file; name a folder.")
    if overwrite:
        return
    if folder.is_dir() and any(folder.iterdir()):
        raise ConfigError(f"`out`: {folder} holds something; name another folder, or add overwrite=true.")
    if truth.exists():
        raise ConfigError(f"`truth`: {truth} exists; name another file, or add overwrite=true.")


def _write_run(made: Simulation, run: RawRun, file: Path) -> Path:
    names = ("t", *made.state_names, *made.input_names, *run.extra)
    table = np.column_stack([run.t, run.x, run.u, *run.extra.values()])
    # times to the nanosecond: sums of steps would show their last digits
    table[:, 0] = np.round(table[:, 0], 9)
    with file.open("w", encoding="utf-8", newline="\n") as out:
        out.write(",".join(names) + "\n")
        out.writelines(",".join(map(repr, row)) + "\n" for row in table.tolist())
    return file
