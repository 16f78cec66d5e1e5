"""What a diagnosis left of a machine: its system, the runs that were looked at, and what was found."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

import nsde_torch
from nsde_torch.data import DataSet, Run
from nsde_torch.diagnosis.files import EFFECTS, REPORT, RESULT, write_content, write_effects
from nsde_torch.diagnosis.report import write_report
from nsde_torch.diagnosis.text import lines
from nsde_torch.effects import files as effects_files
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.recording.faults import remedies
from nsde_torch.systems import System
from nsde_torch.whole_files import read_json

from . import build
from .quoted import as_typed

CONFIG = ".hydra/config.yaml"


@dataclass(frozen=True)
class KnownMachine:
    """A machine after a diagnosis."""

    system: System
    runs: Sequence[Run]  # runs that were looked at
    clock: float  # physical seconds per logged second
    values: Mapping[str, Any]  # effects that were found, with values
    content: Mapping[str, Any]  # of `diagnosis.json`
    data: DictConfig | None = None  # configuration of the data, where it was kept

    @property
    def given(self) -> dict[str, Any]:
        """What the planning and the judging of an experiment take of it."""
        return {"system": self.system, "runs": self.runs, "clock": self.clock, "values": self.values}


def known_machine(
    folder: Path, content: Mapping[str, Any], system: System, data: DataSet, config: DictConfig | None = None
) -> KnownMachine:
    """What a diagnosis knows."""
    runs = [run for run in data.runs if run.name in content["data"]["runs"]]
    clock = float(content["data"].get("clock_scale") or 1.0)
    values = effects_files.read(folder / EFFECTS)[1] if (folder / EFFECTS).is_file() else {}
    return KnownMachine(system, runs, clock, values, content, config)


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


def diagnosed(folder: Path, moved: str | None) -> KnownMachine:
    """Read a diagnosis from its folder, with its runs where they were, or where they have been `moved` to."""
    if not (folder / RESULT).is_file() or not (folder / CONFIG).is_file():
        command = as_typed("nsde", "diagnose", paths={"out_dir": folder})
        raise ConfigError(f"`run`: {folder} holds no {RESULT} with {CONFIG}; `{command}` writes them.")
    content = read_json(folder / RESULT)
    if content.get("so_far"):
        raise ConfigError(
            f"`run`: the diagnosis in {folder} is not finished: what seems open in it may not have been tested yet. "
            "Diagnose again, to the end, into another folder."
        )
    config = OmegaConf.load(folder / CONFIG)
    assert isinstance(config, DictConfig)
    system = build.system(config.system)
    data = config.data
    faults = faults_of_sensors(content)
    for name, values in faults.items():  # what sensors do is undone before any physics
        if name in data:
            data[name] = {**build.options(data)[name], **values}
    if moved is not None:
        _check_there("runs", moved, "where the runs of the diagnosis are now")
        data.path = moved
    all_runs = build.dataset(data, system)
    recorded = content["data"].get("fingerprint")
    if not faults and recorded is not None and all_runs.fingerprint != recorded:
        raise DataError(
            f"{data.get('path', 'the data')} holds other runs than those that {folder} was made of. Say where they are "
            "(runs=FOLDER), or diagnose again."
        )
    return known_machine(folder, content, system, all_runs, data)


def flown_runs(known: KnownMachine, path: str) -> Sequence[Run]:
    """Runs of a flown experiment, read as those of the diagnosis were."""
    _check_there("flown", path, "the log of the experiment")
    assert known.data is not None
    config = known.data.copy()
    if config.kind == "simulated":
        plain = {"kind": "csv", "clock": config.clock, "state_smoothing": "keep", "stream_offsets": "keep"}
        config = OmegaConf.create(plain)
    config.path = path
    found = build.dataset(config, known.system)
    step = known.runs[0].dt
    if abs(found.dt - step) > 1e-3 * step:
        raise DataError(
            f"{path} was logged every {found.dt:g} s, the runs of the diagnosis every {step:g} s. Log it at their "
            "rate, or resample (data.dt) and diagnose again."
        )
    return found.runs


def _check_there(key: str, path: str, what: str) -> None:
    if not Path(path).exists():
        raise ConfigError(f"`{key}`: {path} does not exist; it names {what}, a file or folder.")


# --- logs in one folder: a diagnosis is of those that it names, and one that came later is no part of it ------------


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
    faults: dict[str, Any] = {} if content is None else faults_of_sensors(content)
    return nsde_torch.read(
        folder, system=system, kind=kind, **{k: v for k, v in faults.items() if k in remedies()}
    )


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
