"""What `nsde design` reads of a diagnosis: its system, its runs, and what it found."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from nsde_torch.data import Run
from nsde_torch.diagnosis.files import EFFECTS, RESULT
from nsde_torch.effects import files as effects_files
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.systems import System

from . import build, effects_file

CONFIG = ".hydra/config.yaml"


@dataclass(frozen=True)
class Diagnosed:
    """A diagnosis, found again.

    Args:
        folder: Where it is.
        content: Content of `diagnosis.json`.
        system: Declared system.
        runs: Runs that were looked at.
        clock: Physical seconds per logged second.
        values: Effects that were found, with values.
        data: Configuration of the data.
    """

    folder: Path
    content: Mapping[str, Any]
    system: System
    runs: Sequence[Run]
    clock: float
    values: Mapping[str, Any]
    data: DictConfig


def diagnosed(folder: Path, moved: str | None) -> Diagnosed:
    """Read a diagnosis with its runs.

    Args:
        folder: Folder of `nsde diagnose`.
        moved: Where its runs are now; None for where they were.

    Raises:
        ConfigError: the folder holds no diagnosis.
        DataError: the runs are not those of the diagnosis.
    """
    if not (folder / RESULT).is_file() or not (folder / CONFIG).is_file():
        raise ConfigError(
            f"`run`: {folder} holds no {RESULT} with {CONFIG}; `nsde diagnose out_dir={folder}` writes them."
        )
    content = json.loads((folder / RESULT).read_text(encoding="utf-8"))
    config = OmegaConf.load(folder / CONFIG)
    assert isinstance(config, DictConfig)
    effects_file.expand(config.system)
    system = build.system(config.system)
    data = config.data
    for finding in content["findings"]:  # what sensors do is undone before any physics
        if finding["kind"] == "recording" and finding["name"] in data:
            values = {
                k.partition(".")[2]: v["value"]
                for k, v in content["parameters"].items()
                if k.startswith(f"{finding['name']}.")
            }
            data[finding["name"]] = {**build.options(data)[finding["name"]], **values}
    if moved is not None:
        data.path = moved
    all_runs = build.dataset(data, system)
    recorded = content["data"].get("fingerprint")
    plain = not any(f["kind"] == "recording" for f in content["findings"])
    if plain and recorded is not None and all_runs.fingerprint != recorded:
        raise DataError(
            f"{data.get('path', 'the data')} holds other runs than those that {folder} was made of. Say where they are "
            "(runs=FOLDER), or diagnose again."
        )
    names = set(content["data"]["runs"])
    runs = [run for run in all_runs.runs if run.name in names]
    values = effects_files.read(folder / EFFECTS)[1] if (folder / EFFECTS).is_file() else {}
    clock = float(content["data"].get("clock_scale") or 1.0)
    return Diagnosed(folder, content, system, runs, clock, values, data)


def flown_runs(known: Diagnosed, path: str) -> Sequence[Run]:
    """Runs of a flown experiment, read as those of the diagnosis were.

    Raises:
        DataError: they are on another step, or cannot be read as runs of this machine.
    """
    config = known.data.copy()
    if config.kind == "simulated":
        config = OmegaConf.create(
            {
                "kind": "csv",
                "test": None,
                "test_path": None,
                "validation": 0.15,
                "gap": None,
                "clock": config.clock,
                "instruments": [],
                "state_smoothing": "keep",
                "stream_offsets": "keep",
            }
        )
    config.path = path
    found = build.dataset(config, known.system)
    step = known.runs[0].dt
    if abs(found.dt - step) > 1e-3 * step:
        raise DataError(
            f"{path} was logged every {found.dt:g} s, the runs of the diagnosis every {step:g} s. Log it at their "
            "rate, or resample (data.dt) and diagnose again."
        )
    return found.runs
