"""Runs of any machine: inputs that are sums of sines, first states drawn at random (`Excitation`)."""

from __future__ import annotations

from collections.abc import Sequence
from math import pi

import numpy as np
import torch

from nsde_torch.data.raw import RawRun
from nsde_torch.errors import ConfigError
from nsde_torch.simulation import Making, make_plant
from nsde_torch.simulation.make import plant_options
from nsde_torch.simulation.recorder import record
from nsde_torch.systems.machine import Excitation
from nsde_torch.systems.machines import Effects, machine

SINES = 6
"""Sines of each input."""


def excited_runs(
    name: str,
    *,
    durations: Sequence[float] | None = None,
    seed: int,
    effects: Effects = (),
    process_noise: float = 1.0,
    sensor_noise: float = 1.0,
    making: Making | None = None,
    size: float = 1.0,
) -> list[RawRun]:
    """Runs of a machine as its `excitation` says.

    Args:
        name: System.
        durations: Length of each run [s]; default: those of the excitation.
        seed: Seed of first states, inputs and noise.
        effects: Effects that the plant has beyond its own.
        process_noise: Factor on the gusts.
        sensor_noise: Factor on the sensor noise.
        making: How the plant is made.
        size: Factor on the swing of the inputs.

    Returns:
        Runs on the machine's sample (or that of `making`): measured states and the inputs.

    Raises:
        ConfigError: the machine says nothing of how it is excited, an unknown effect, or a number out of range.
    """
    plant_of = machine(name)
    how = plant_of.excitation
    if how is None:
        raise ConfigError(
            f"the machine of {name!r} says neither `excitation` nor `recording`; say one, so that it can be simulated."
        )
    if not size > 0:
        raise ConfigError(f"`size` must be a factor above 0; got {size!r}.")
    lengths = how.durations if durations is None else durations
    rng = np.random.default_rng([seed, 1])
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    plant = make_plant(
        name,
        generator=generator,
        effects=effects,
        process_noise=process_noise,
        sensor_noise=sensor_noise,
        **plant_options(making),
    )
    start = _starts(how, len(lengths), plant.system.nx, rng, name)
    swing = size * np.asarray(how.size) * np.sqrt(2.0 / SINES)
    mean = np.asarray(how.mean or (0.0,) * len(how.size))
    if swing.shape != (plant.system.nu,) or mean.shape != swing.shape:
        raise ConfigError(
            f"`excitation` of {name!r} needs a size and a mean for each of {plant.system.nu} inputs; got {how}."
        )
    shape = (len(lengths), plant.system.nu, SINES)
    hertz = np.exp(rng.uniform(np.log(how.hertz[0]), np.log(how.hertz[1]), shape))
    phase = rng.uniform(0.0, 2.0 * pi, shape)

    def control(t: float, x: torch.Tensor) -> torch.Tensor:
        waves = np.sin(2.0 * pi * hertz * t + phase).sum(2)
        return torch.as_tensor(mean + swing * waves)

    return record(plant, start, control, durations=lengths, prefix="run")


def _starts(how: Excitation, n: int, nx: int, rng: np.random.Generator, name: str) -> np.ndarray:
    if not how.start:
        return np.zeros((n, nx))
    bounds = np.asarray(how.start, dtype=np.float64)
    if bounds.shape != (nx, 2) or (bounds[:, 1] < bounds[:, 0]).any():
        raise ConfigError(
            f"`excitation.start` of {name!r} must be (lowest, highest) of {nx} states; got {how.start}."
        )
    return rng.uniform(bounds[:, 0], bounds[:, 1], (n, nx))
