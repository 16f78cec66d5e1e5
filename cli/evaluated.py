"""What `nsde evaluate` is given: finished runs of one system, and the data to score their models on."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from nsde_torch.data import DataSet, Run, SystemInfo
from nsde_torch.data import split as split_runs
from nsde_torch.data.run import resolve
from nsde_torch.errors import CheckpointError, ConfigError, DataError
from nsde_torch.models import Model
from nsde_torch.models.run_directory import CONFIG, METRICS, load
from nsde_torch.plain_yaml import read_yaml

from . import build
from .jobs import FAILED
from .own_modules import see_own_modules
from .quoted import as_typed

TRAINED = "trained"


def read_runs(given: object, names: Sequence[str] | None, device: Any) -> dict[str, Model]:
    """The models of the runs of the key `run`, by names that were given or made from the folders."""
    folders = _folders(given)
    if names is None:
        names = short_names(folders)
    if len(names) != len(folders) or len(set(names)) < len(names):
        raise ConfigError(
            f"`names` must hold one name for each of the {len(folders)} runs, all different; got {names}."
        )
    found = {}
    for name, folder in zip(names, folders, strict=True):
        if wrong := _unfinished(folder):
            raise CheckpointError(f"`run={folder}`: {wrong}")
        see_own_modules(folder)
        found[name] = load(folder, device=device)
    first = next(iter(found.values()))
    for other in found.values():
        if other.spec.system != first.spec.system:
            raise ConfigError(
                f"`run`: only models of one system can be compared; {first.folder} is of {first.spec.system}, "
                f"{other.folder} of {other.spec.system}. Evaluate them one by one."
            )
    return found


def _folders(given: object) -> list[Path]:
    listed = list(given) if isinstance(given, (list, tuple)) else [given]
    if not listed or not all(isinstance(item, str) and item for item in listed):
        raise ConfigError(f"`run` must be a run directory, or a list of them: run=[A,B]; got {given!r}.")
    folders = [Path(str(item)) for item in listed]
    places = [folder.resolve() for folder in folders]
    if twice := [f for f, place in zip(folders, places, strict=True) if places.count(place) > 1]:
        raise ConfigError(f"`run` names {twice[0]} twice.")
    return folders


def short_names(folders: Sequence[Path]) -> list[str]:
    """As much of the end of each path as distinguishes them."""
    parts = [folder.resolve().parts for folder in folders]
    for count in range(1, max(map(len, parts)) + 1):
        names = ["/".join(p[-count:]) for p in parts]
        if len(set(names)) == len(names):
            break
    return names


def _unfinished(folder: Path) -> str:
    """What is wrong with a folder without `metrics.json`, which is the last thing that a training writes."""
    if not folder.is_dir():
        return "no such folder; give the folder that `nsde train` printed."
    if (folder / METRICS).is_file():
        return ""
    jobs = sorted(path.parent.name for path in folder.glob(f"*/{METRICS}"))
    if jobs:
        return (
            f"this holds {len(jobs)} runs (a sweep?), not one; name those to compare, run=[{folder}/{jobs[0]},...], "
            "names with = or , in quotes."
        )
    if (folder / FAILED).is_file():
        return f"this training failed (see {folder / FAILED}); train again."
    # a flight has .hydra too, and nothing continues it
    if (folder / "train.log").is_file() or (folder / CONFIG).is_file():
        command = as_typed("nsde", "train", paths={"resume": folder})
        return f"this training has not finished (no {METRICS}); finish it with `{command}`."
    return f"this is no run directory (no {METRICS}); give the folder that `nsde train` printed."


def choose(config: DictConfig, trained: Model, machine: SystemInfo) -> tuple[DataSet, Sequence[Run], bool]:
    """Data set and runs to score on that the group `data` asks for, and whether they are of a `data.test_path`."""
    if config.kind != TRAINED:
        return _runs_of(config, machine, every=True)
    assert trained.folder is not None
    own = _trained_data(trained.folder)
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


def _trained_data(folder: Path) -> DictConfig:
    """The group `data` that a run was trained with; ConfigError where it was trained without the command line."""
    content = read_yaml(folder / CONFIG)
    config = content.get("config") if isinstance(content, dict) else None
    if not isinstance(config, dict) or "data" not in config:
        raise ConfigError(
            f"{folder} does not say which data it was trained with (it was not trained by `nsde train`); "
            "choose some with data=csv data.path=..., or data=simulated."
        )
    return OmegaConf.create(dict(config["data"]))


def _runs_of(config: DictConfig, machine: SystemInfo, *, every: bool) -> tuple[DataSet, Sequence[Run], bool]:
    if (other := build.test_data(config, machine)) is not None:
        return other, other.runs, True
    data = build.dataset(config, machine)
    if config.test is not None:
        runs = [data.runs[k] for k in dict.fromkeys(resolve(data.runs, list(config.test)))]
    elif every:
        runs = list(data.runs)
    else:
        runs = list(split_runs(data).test)
    if not runs:
        raise DataError(f"no run is held out of {', '.join(data.names)}; name runs with data.test=[...].")
    return data, runs, False
