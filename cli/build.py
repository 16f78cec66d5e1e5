"""From a checked configuration to the objects of the library; the only file that knows both."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from nsde_torch.data import DataSet, Split, read
from nsde_torch.data import split as split_runs
from nsde_torch.errors import ConfigError
from nsde_torch.sde import Step, make_step
from nsde_torch.systems import System, make_system

# Keys of a data configuration that are not options of a reader.
_NOT_FOR_READERS = ("kind", "test", "validation")


def settings(config: DictConfig, *, sweep: bool) -> tuple[torch.device, torch.dtype]:
    """Set the number of threads; return device and precision.

    Args:
        config: The configuration, with `device`, `dtype` and `threads`.
        sweep: Whether this is a job of a sweep, which has one thread whatever `threads` says.

    Raises:
        ConfigError: The device is unknown or not there.
    """
    torch.set_num_threads(1 if sweep else config.threads)
    return make_device(config.device), {"float32": torch.float32, "float64": torch.float64}[config.dtype]


def make_device(name: str) -> torch.device:
    """The device of that name.

    Raises:
        ConfigError: There is no such device here.
    """
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ConfigError(f"`device` must be cpu, cuda or cuda:N; got {name!r}.") from None
    if device.type not in ("cpu", "cuda"):
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


def system(config: DictConfig) -> System:
    """The machine of the group `system`.

    Raises:
        ConfigError: There is no such system, effect, parameter or option.
    """
    return make_system(
        config.name,
        effects=list(config.effects),
        declared=None if config.declared is None else list(config.declared),
        values=dict(_dotted(options(config)["parameters"])),
        **options(config)["options"],
    )


def _dotted(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """`{effect: {name: 1}}`, as an override with dots makes it, as `effect.name`."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def dataset(config: DictConfig, machine: System) -> DataSet:
    """Read or simulate the runs.

    Args:
        config: The group `data`.
        machine: The system that the runs are of.

    Raises:
        DataError: The data cannot be used.
        ConfigError: An option is wrong.
    """
    return read(config.kind, machine, **options(config, *_NOT_FOR_READERS))


def split(config: DictConfig, data: DataSet) -> Split:
    """Training runs and runs held out for the test; `data.test` names them by index or name.

    Raises:
        DataError: There is no such run, or no run is left on a side.
    """
    return split_runs(data, None if config.test is None else list(config.test))


def step(config: DictConfig, machine: System) -> Step:
    """The integrator of the group `solver`; null is the system's own."""
    return make_step(config.name or machine.defaults.step)
