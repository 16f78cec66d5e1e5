"""The runs that `nsde evaluate` scores models on: those that the first was tested on, or any others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from omegaconf import DictConfig, OmegaConf

from nsde_torch.data import DataSet, Run, SystemInfo
from nsde_torch.data import split as split_runs
from nsde_torch.data.run import resolve
from nsde_torch.errors import ConfigError, DataError

from . import build
from .evaluated_runs import TrainedRun

TRAINED = "trained"


@dataclass(frozen=True)
class Chosen:
    """Runs to score on."""

    data: DataSet  # the data set that they are of
    runs: Sequence[Run]  # the runs
    other_sensors: bool  # whether they are the runs of a `data.test_path`, recorded by other sensors perhaps


def choose(config: DictConfig, trained: TrainedRun, machine: SystemInfo) -> Chosen:
    """The runs that the configuration asks for.

    Args:
        config: The group `data`; of the kind "trained", it means that of a run.

    Raises:
        ConfigError: nothing says which data.
        DataError: the data cannot be used.
    """
    if config.kind != TRAINED:
        return _runs_of(config, machine, every=True)
    own = trained_data(trained)
    for key in ("test", "test_path"):
        if config[key] is not None:
            own[key] = config[key]
    if config.test is not None and config.test_path is None:
        own["test_path"] = None
    try:
        return _runs_of(own, machine, every=False)
    except DataError as error:
        where = f" (`data.path={own.path}`)" if own.get("path") else ""
        raise DataError(
            f"the data that {trained.folder} was trained with{where}: {error} Other data are "
            "named with data=csv data.path=..."
        ) from error


def trained_data(trained: TrainedRun) -> DictConfig:
    """The group `data` that a run was trained with; ConfigError where it was trained without the command line."""
    if "data" not in trained.trained:
        raise ConfigError(
            f"{trained.folder} does not say which data it was trained with (it was not trained by `nsde train`); "
            "choose some with data=csv data.path=..., or data=simulated."
        )
    made = OmegaConf.create(dict(trained.trained["data"]))
    assert isinstance(made, DictConfig)
    return made


def training_runs(trained: TrainedRun) -> Sequence[Run]:
    """The runs that a model was trained on, read again; ConfigError or DataError where they cannot be."""
    own, machine = trained_data(trained), trained.model.system
    return build.split(own, build.dataset(own, machine), machine).train


def record_sensors(runs: Sequence[TrainedRun]) -> None:
    """Tell models of older versions, which did not record it, what sensors their training data had."""
    from nsde_torch.models.capabilities import learns_sensors
    from nsde_torch.training.prepare import sensor_std

    for run in runs:
        if learns_sensors(run.model) and "train_sensor_std" not in run.metrics:
            std = sensor_std(training_runs(run)).tolist()
            known = dict(zip(run.model.system.state_names, std, strict=True))
            run.model.metrics = {**run.metrics, "train_sensor_std": known}


def _runs_of(config: DictConfig, machine: SystemInfo, *, every: bool) -> Chosen:
    if config.test_path is not None:
        other = build.other_dataset(config, machine)
        return Chosen(other, other.runs, True)
    data = build.dataset(config, machine)
    if config.test is not None:
        runs = [data.runs[k] for k in dict.fromkeys(resolve(data.runs, list(config.test)))]
    elif every:
        runs = list(data.runs)
    else:
        runs = list(split_runs(data).test)
    if not runs:
        raise DataError(f"no run is held out of {', '.join(data.names)}; name runs with data.test=[...].")
    return Chosen(data, runs, False)
