"""From a checked configuration to the objects of the library; the only file that knows both.

What reads and checks data is imported where it is called: flights need none of it, and it takes half a second to load.
"""

import contextlib
from dataclasses import fields
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from nsde_torch.data import DataSet, SystemInfo
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.models import MODELS, ModelOptions
from nsde_torch.models.kind import model_options as options_of_model
from nsde_torch.sde import IntegratorOptions, TorchDiffEqOptions
from nsde_torch.systems import System, SystemOptions
from nsde_torch.systems.options import system_options as options_of_system

# Keys of a data configuration that are not arguments of the function that makes or reads the data.
_NOT_FOR_DATA = ("test", "test_path", "validation", "instruments")


def make_device(name: str) -> torch.device:
    """The device of that name; ConfigError where there is none here."""
    device = None
    with contextlib.suppress(RuntimeError):
        device = torch.device(name)
    if device is None or device.type not in ("cpu", "cuda"):
        raise ConfigError(f"`device` must be cpu, cuda or cuda:N; got {name!r}.")
    there = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if device.type == "cuda" and not there:
        raise ConfigError(
            f"`device={name}`, but torch {torch.__version__} sees no CUDA device. Use device=cpu."
        )
    if device.type == "cuda" and (device.index or 0) >= there:
        raise ConfigError(f"`device={name}`, but there are {there} CUDA devices (0 first).")
    return device


def options(config: DictConfig, *left_out: str) -> dict[str, Any]:
    """A part of the configuration as keyword arguments."""
    plain = OmegaConf.to_container(config, resolve=True)
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items() if key not in left_out}


def shared(library: type[Any], config: DictConfig) -> dict[str, Any]:
    """The fields of a class of options that a part of the configuration has too; lists are tuples there."""
    given = options(config)
    return {f.name: _tupled(given[f.name]) for f in fields(library) if f.name in given}


def _tupled(value: Any) -> Any:
    return tuple(map(_tupled, value)) if isinstance(value, list) else value


def fence(config: DictConfig, group: str, walls: int | None = 3) -> tuple[tuple[float, float], ...]:
    """The key `fence` of a group: lowest and highest x, y, z [m], or as many pairs as wanted; else a ConfigError."""
    rows = options(config)["fence"]
    with contextlib.suppress(TypeError, ValueError):
        pairs = tuple((float(low), float(high)) for low, high in rows)
        if walls in (None, len(pairs)) and all(low < high for low, high in pairs):
            return pairs
    raise ConfigError(f"`{group}.fence` takes [[x_low,x_high],[y_low,y_high],[z_low,z_high]]; got {rows!r}.")


def dataset(config: DictConfig, machine: SystemInfo) -> DataSet:
    """Read or simulate the runs of the group `data`; ConfigError for a wrong option, DataError for unusable data."""
    if config.kind == "simulated":
        from nsde_torch.simulation import simulated

        return simulated(
            machine, **options(config, "kind", "options", *_NOT_FOR_DATA), **options(config.options)
        )
    return _files(config, machine, config.path)


def test_data(config: DictConfig, machine: SystemInfo) -> DataSet | None:
    """The runs of `data.test_path`, read as those of `data.path`; None without one, a DataError for unusable ones."""
    if config.test_path is None:
        return None
    try:
        return _files(config, machine, config.test_path)
    except DataError as error:
        raise DataError(str(error).replace("`path`", "`data.test_path`")) from error


def beside(config: DictConfig, machine: SystemInfo) -> dict[str, Any]:
    """What the group `data` says beside the data, as arguments of a training or a diagnosis."""
    given = options(config)
    return {name: given[name] for name in ("test", "instruments")} | {"test_data": test_data(config, machine)}


def _files(config: DictConfig, machine: SystemInfo, path: str) -> DataSet:
    """What is in files, read as the group `data` says."""
    import nsde_torch

    return nsde_torch.read(path, system=machine, **options(config, "path", *_NOT_FOR_DATA))


def system_options(config: DictConfig) -> SystemOptions:
    """The group `system`, effects of files in the place of their names; ConfigError for a file that cannot be used."""
    given = options(config)
    effects = given.pop("effects")
    return options_of_system(SystemOptions(**given), effects=effects)


def system(config: DictConfig) -> System:
    """The machine of the group `system`; ConfigError where there is no such system, effect, parameter or option."""
    return system_options(config).make()


def model_options(config: DictConfig) -> ModelOptions:
    """The group `model`."""
    given = options(config, "kind")
    values = given if config.kind in MODELS else given.pop("options", {})
    return options_of_model(config.kind, **values)


def integrator(config: DictConfig) -> IntegratorOptions:
    """The group `solver`."""
    given = options(config)
    return TorchDiffEqOptions(**given) if "method" in given else IntegratorOptions(**given)
