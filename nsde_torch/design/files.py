"""The files of a plan: `design.json`, `plan.csv` and `design.png`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nsde_torch.errors import ConfigError

if TYPE_CHECKING:
    from nsde_torch.design.experiment import Experiment

Array = NDArray[np.float64]
RESULT, PLAN, PICTURE = "design.json", "plan.csv", "design.png"


def save(experiment: Experiment, folder: str | Path) -> Path:
    """Write all files of a plan (`Experiment.save`)."""
    from nsde_torch.design.pictures import picture
    from nsde_torch.plots.style import save as save_figure

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(experiment.content(), indent=1, allow_nan=False)
    (folder / RESULT).write_text(text + "\n", encoding="utf-8")
    write_plan(folder / PLAN, tuple(experiment.given), experiment.rows())
    save_figure(picture(experiment), folder / PICTURE)
    return folder


def write_plan(file: Path, names: tuple[str, ...], rows: Array) -> None:
    """Write a plan as CSV: times and what is given from then on, (n, 1 + columns)."""
    with file.open("w", encoding="utf-8", newline="\n") as out:
        out.write(",".join(("t", *names)) + "\n")
        out.writelines(",".join(f"{v:.9g}" for v in row) + "\n" for row in rows.tolist())


def read_design(folder: str | Path) -> dict[str, Any]:
    """Content of `design.json`.

    Raises:
        ConfigError: the folder holds none.
    """
    file = Path(folder) / RESULT
    if not file.is_file():
        raise ConfigError(f"{folder} holds no {RESULT}; `nsde design` writes one.")
    content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return content
