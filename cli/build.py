"""From a checked configuration to the objects of the library; the only file that knows both.

What reads and checks data is imported where it is called: flights need none of it, and it takes half a second to load.
"""

import contextlib
from dataclasses import fields
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf, open_dict

from nsde_torch.data import DataSet, SystemInfo
from nsde_torch.effects.files import is_file, own_name, read_for
from nsde_torch.effects.law import split_name
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.models import MODELS, ModelOptions
from nsde_torch.models.kind import model_options as options_of_model
from nsde_torch.sde import IntegratorOptions, TorchDiffEqOptions
from nsde_torch.systems import System, SystemOptions

# Keys of a data configuration that are not arguments of the function that makes or reads the data.
_NOT_FOR_DATA = ("test", "test_path", "validation", "instruments")


def make_device(name: str) -> torch.device:
    """The device of that name; ConfigError where there is none here."""
    device = None
    with contextlib.suppress(RuntimeError):
        device = torch.device(name)
    if device is None or device.type not in ("cpu", "cuda"):
        raise ConfigError(f"`device` must be cpu, cuda or cuda:N; got {name!r}.")
    if device.type == "cuda":
        if not torch.cuda.is_available():
            raise ConfigError(
                f"`device={name}`, but torch {torch.__version__} sees no CUDA device. Use device=cpu."
            )
        if device.index is not None and device.index >= torch.cuda.device_count():
            raise ConfigError(
                f"`device={name}`, but there are {torch.cuda.device_count()} CUDA devices (0 first)."
            )
    return device


def options(config: DictConfig, *left_out: str) -> dict[str, Any]:
    """A part of the configuration as keyword arguments."""
    plain = OmegaConf.to_container(config, resolve=True)
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items() if key not in left_out}


def shared(library: type[Any], config: DictConfig) -> dict[str, Any]:
    """The fields of a class of options that a part of the configuration has too, as keyword arguments."""
    given = options(config)
    return {f.name: given[f.name] for f in fields(library) if f.name in given}


def fence(config: DictConfig, group: str, walls: int | None = 3) -> tuple[tuple[float, float], ...]:
    """The key `fence` of a group: lowest and highest x, y, z [m], or as many pairs as wanted; else a ConfigError."""
    rows = options(config)["fence"]

    def wall(row: Any) -> bool:
        number = isinstance(row, list) and all(type(end) in (int, float) for end in row)
        return number and len(row) == 2 and row[0] < row[1]

    if not (isinstance(rows, list) and walls in (None, len(rows)) and all(map(wall, rows))):
        raise ConfigError(
            f"`{group}.fence` takes [[x_low,x_high],[y_low,y_high],[z_low,z_high]]; got {rows!r}."
        )
    return tuple((float(low), float(high)) for low, high in rows)


def system(config: DictConfig) -> System:
    """The machine of the group `system`; ConfigError where there is no such system, effect, parameter or option."""
    return system_options(config).make()


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
    tested = test_data(config, machine)
    return {"test": given["test"], "test_data": tested, "instruments": given["instruments"]}


def _files(config: DictConfig, machine: SystemInfo, path: str) -> DataSet:
    """What is in files, read as the group `data` says."""
    import nsde_torch

    return nsde_torch.read(path, system=machine, **options(config, "path", *_NOT_FOR_DATA))


def system_options(config: DictConfig) -> SystemOptions:
    """The group `system`."""
    return SystemOptions(**options(config))


def model_options(config: DictConfig) -> ModelOptions:
    """The group `model`."""
    given = options(config, "kind")
    values = given if config.kind in MODELS else given.pop("options", {})
    return options_of_model(config.kind, **values)


def integrator(config: DictConfig) -> IntegratorOptions:
    """The group `solver`."""
    given = options(config)
    return TorchDiffEqOptions(**given) if "method" in given else IntegratorOptions(**given)


# --- system.effects=PATH: the effects of a file in the place of its name ----------------------------------------------


def expand_effects(system: DictConfig) -> None:
    """Put the effects of files in the place of their names, and their values under `system.parameters`."""
    names: list[str] = []
    for entry in system.effects:
        if not is_file(entry):
            names.append(entry)
            continue
        effects = read_for(entry, system.name)
        names += effects
        for effect, values in effects.items():
            for key, value in values.items():
                add_value(system, own_name(effect), key, value)
    system.effects = names


def add_value(system: DictConfig, effect: str, name: str, value: Any) -> None:
    """Set `system.parameters.EFFECT.NAME` unless it was given."""
    with open_dict(system.parameters):
        given = system.parameters
        law, coordinate = split_name(effect)
        # on the command line the coordinate is a level of its own
        placed = ((given.get(law) or {}).get(coordinate) or {}) if coordinate else {}
        if f"{effect}.{name}" in given or name in placed:
            return
        if effect not in given:
            given[effect] = {}
        if name not in given[effect]:
            given[effect][name] = value


def add_own(system: DictConfig, name: str, value: Any) -> None:
    """Set `system.parameters.NAME` of the system itself unless it was given."""
    with open_dict(system.parameters):
        if name not in system.parameters:
            system.parameters[name] = value
