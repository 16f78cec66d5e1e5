"""Keys of the group `data`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from nsde_torch.data.readers import READERS, Reader
from nsde_torch.recording.faults import RemedyOptions

from ..keys import key, mirrors


@dataclass
class RunChoice:
    """Which runs of a data set are held out, or scored on."""

    kind: str = key("???", "kind of the data set, set by data=")
    test: list[Any] | None = key(
        None, "runs to test on, by index or name; null: the last run (evaluate with data=: all)"
    )
    test_path: str | None = key(
        None,
        "file or folder of further runs to test on, recorded by sensors of another noise perhaps",
        file=True,
    )


@dataclass
class DataConfig(RunChoice):
    """What every data set has."""

    validation: float = key(
        0.15, "share of the training runs' time that early stopping looks at", low=0.01, high=0.5
    )
    gap: float | None = key(
        None, "a longer pause between rows splits a run; null: 2.5 steps of the data", unit="s", above=0
    )
    clock: str = key(
        "rescale",
        "what to do when the kinematics disagree with the clock",
        choices=("rescale", "trust", "refuse"),
    )
    instruments: list[str] = key(
        [],
        "logged columns that nothing inside the control loop moves: sticks, setpoints, data.instruments=[stick_roll]",
    )


@dataclass
class SimulatedData(DataConfig):
    """Runs made by a plant in the package."""

    kind: str = key("simulated", "kind of the data set, set by data=")
    durations: list[float] | None = key(None, "length of each run; null: the system's own", unit="s", above=0)
    seed: int = key(0, "seed of the simulated flights and their noise", low=0)
    effects: Any = key(
        [],
        "effects that the plant has and the model does not declare: names, or {NAME: {parameter: 1}}",
        file=True,
    )
    process_noise: float = key(1.0, "strength of the gusts, relative to the plant's own", low=0)
    sensor_noise: float = key(1.0, "strength of the measurement noise, relative to the plant's own", low=0)
    cache: str | None = key(
        None, "folder that keeps simulated runs; null: NSDE_CACHE or the user's cache folder", file=True
    )
    options: dict[str, Any] = key({}, "further options of the system's recording, data.options.NAME=1")


@dataclass
class Files(DataConfig):
    """Where runs are read from."""

    path: str = key("???", "file or folder to read", file=True)
    dt: float | None = key(None, "step to resample to; null: the step of the data", unit="s", above=0)
    state_smoothing: str = key(
        "restore",
        "what to do with states that were smoothed before they were logged",
        choices=("restore", "keep"),
    )
    derived_rates: str = key(
        "infer", "what to do with rates that were made of positions", choices=("infer", "keep")
    )
    most_rows: int | None = key(
        None,
        "rows in all that are used of a longer log, in stretches spread over each run; null: as many as hold 1.5 "
        "million states and inputs",
        low=2,
    )
    stream_offsets: str = key(
        "undo", "what to do with streams whose offsets differ between runs", choices=("undo", "keep")
    )


@mirrors(RemedyOptions)
class FileData(Files):
    """Runs read from files, and what is to be taken out of them."""


@dataclass
class MappedData(FileData):
    """Runs read from logs through a mapping."""

    mapping: str | None = key(
        None,
        "YAML file that says what columns mean, as `nsde inspect` writes it; null: mapping.yaml beside the logs, else "
        "a proposal",
        file=True,
    )


@dataclass
class OwnData(FileData):
    """Runs that a reader of the user's own returns."""

    kind: str = key("???", "the reader: module:function of your own")
    options: dict[str, Any] = key({}, "its further arguments, data.options.NAME=1")


def _keys_of(kind: str, reader: Reader) -> type:
    """Keys of a reader of the package."""
    space = {
        "__annotations__": {"kind": "str"},
        "__doc__": reader.summary,
        "__module__": __name__,
        "kind": key(kind, "kind of the data set, set by data="),
    }
    return dataclass(type(f"{kind.title()}Data", (MappedData if reader.mapped else FileData,), space))


DATA_CHOICES: dict[str, type] = {
    "simulated": SimulatedData,
    **{kind: _keys_of(kind, reader) for kind, reader in READERS.items()},
    "own": OwnData,
}
"""Choices of the group `data`: the plants of the package, every reader, and one of the user's own."""
# a configuration that a sweep sends to another process finds its class by name
globals().update({cls.__name__: cls for cls in DATA_CHOICES.values()})
