"""Runs of any machine: inputs that are sums of sines, first states drawn at random (`Excitation`)."""

from collections.abc import Sequence
from dataclasses import replace
from math import pi
from typing import Any

import numpy as np
import torch

from nsde_torch.data.raw import RawRun
from nsde_torch.errors import ConfigError
from nsde_torch.lookup import function_by_name
from nsde_torch.simulation.make import Making, record
from nsde_torch.systems import system_class
from nsde_torch.systems.machine import Excitation, Machine
from nsde_torch.systems.machines import machine

SINES = 6  # sines of each input
SPRING_DURATIONS = (5.0,) * 5
REGION = ((-0.1, 0.1), (-0.1, 0.1))  # where runs start: bounds of q [m] and q_dot [m/s]
FORCES = ("zero", "multisine")
FORCE_SIZE = 0.05  # standard deviation of the multisine [N]


def excited_runs(
    name: str,
    *,
    durations: Sequence[float] | None = None,
    seed: int,
    making: Making = Making(),
    size: float = 1.0,
    inputs: Sequence[float] | None = None,
    noise: Sequence[float] | None = None,
    hertz: Sequence[float] | None = None,
    start: Sequence[Sequence[float]] | None = None,
    controller: str | None = None,
) -> list[RawRun]:
    """Runs of a machine as its `excitation` says, or as is said here.

    They are on the machine's sample (or that of `making`): measured states and the inputs. A ConfigError where nothing
    says how the machine is excited, an effect is unknown, or a number out of range.

    Args:
        durations: Length of each run [s]; default: those of the excitation.
        seed: Seed of first states, inputs and noise.
        size: Factor on the amplitude of the inputs.
        inputs: Standard deviation of each input [its unit].
        noise: Standard deviation of the sensor noise of each error channel [its unit].
        hertz: Lowest and highest frequency [Hz].
        start: Lowest and highest first value of each state [its unit].
        controller: `module:function` of the user's own: inputs (B, nu) from the time [s] and the measured states
            (B, nx), to which the sums of sines are added.
    """
    plant_of, cls = machine(name), system_class(name)
    how = _excitation(
        name,
        plant_of,
        said=inputs is not None and noise is not None,
        size=None if inputs is None else tuple(inputs),
        mean=None if inputs is None else (),
        hertz=None if hertz is None else tuple(hertz),
        start=None if start is None else tuple(map(tuple, start)),
    )
    if not size > 0:
        raise ConfigError(f"`size` must be a factor above 0; got {size!r}.")
    feedback = None if controller is None else function_by_name(controller, kind="controller")
    lengths = how.durations if durations is None else durations
    rng = np.random.default_rng([seed, 1])
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    plant = making.plant(name, generator=generator, sensor_std=noise)
    starts = _starts(how, len(lengths), plant.system.nx, rng, name)
    swing = size * np.asarray(how.size) * np.sqrt(2.0 / SINES)
    mean = np.asarray(how.mean or (0.0,) * len(how.size))
    if swing.shape != (plant.system.nu,) or mean.shape != swing.shape:
        raise ConfigError(
            f"`excitation` of {name!r} needs a size and a mean for each of {plant.system.nu} inputs; got {how}."
        )
    shape = (len(lengths), plant.system.nu, SINES)
    frequencies = np.exp(rng.uniform(np.log(how.hertz[0]), np.log(how.hertz[1]), shape))
    phase = rng.uniform(0.0, 2.0 * pi, shape)

    def control(t: float, x: torch.Tensor) -> torch.Tensor:
        waves = swing[:, None] * np.sin(2.0 * pi * frequencies * t + phase)
        u = torch.as_tensor(mean + waves.sum(2))
        if feedback is None:
            return u
        answer = torch.as_tensor(feedback(t, x), dtype=u.dtype)
        if answer.shape != u.shape:
            raise ConfigError(
                f"controller {controller!r} must return inputs {tuple(u.shape)} (runs, "
                f"{', '.join(cls.input_names)}) for states {tuple(x.shape)}; got {tuple(answer.shape)}."
            )
        return u + answer

    return record(plant, starts, control, durations=lengths, prefix="run")


def _excitation(name: str, plant_of: Machine, *, said: bool, **changes: Any) -> Excitation:
    """How a machine is excited, by its class, with what is changed of it; or by what is `said`."""
    how, cls = plant_of.excitation, system_class(name)
    if how is None and not said:
        units = ", ".join(f"{n} [{u}]" for n, u in zip(cls.input_names, cls.input_units, strict=True))
        raise ConfigError(
            f"the class of {name!r} says no `machine`, so say how its runs are made: options.inputs=[...], the "
            f"standard deviation of each input ({units}), and options.noise=[...], that of the sensor noise of each of "
            f"{', '.join(cls.error_names)}. Or write `machine = Machine(..., excitation=Excitation(...))` into it."
        )
    return replace(how or Excitation(()), **{k: v for k, v in changes.items() if v is not None})


def _starts(how: Excitation, n: int, nx: int, rng: np.random.Generator, name: str) -> np.ndarray:
    if not how.start:
        return np.zeros((n, nx))
    bounds = np.asarray(how.start, dtype=np.float64)
    if bounds.shape != (nx, 2) or (bounds[:, 1] < bounds[:, 0]).any():
        raise ConfigError(
            f"`excitation.start` of {name!r} must be (lowest, highest) of {nx} states; got {how.start}."
        )
    return rng.uniform(bounds[:, 0], bounds[:, 1], (n, nx))


def spring_runs(
    name: str = "mass_spring_damper",
    *,
    durations: Sequence[float] | None = None,
    seed: int,
    force: str = "zero",
    force_size: float = FORCE_SIZE,
    making: Making = Making(),
    region: Sequence[Sequence[float]] = REGION,
) -> list[RawRun]:
    """Runs of the mass-spring-damper of the supplement: m = 1, b = 0.5, k = 1, five runs of 5 s at 100 Hz.

    First states are uniform in [-0.1, 0.1] x [-0.1, 0.1] (the set D2); the force is zero, as there, or a random
    multisine of 0.05 to 1.5 Hz (`Excitation`), which, unlike free decay, also shows the mass. `region` is where runs
    start, ((lowest q, highest q), (lowest q_dot, highest q_dot)). For the rest see `excited_runs`.
    """
    if force not in FORCES:
        raise ConfigError(f"`force` must be one of {', '.join(FORCES)}; got {force!r}.")
    if not force_size > 0:
        raise ConfigError(f"`force_size` must be above 0 N; got {force_size!r}.")
    bounds = np.asarray(region, dtype=np.float64)
    if bounds.shape != (2, 2) or (bounds[:, 1] < bounds[:, 0]).any():
        raise ConfigError(f"`region` must be ((low, high), (low, high)) of q and q_dot; got {region!r}.")
    lengths, std = SPRING_DURATIONS if durations is None else durations, machine(name).sensor_std
    inputs = [force_size if force == "multisine" else 0.0]
    return excited_runs(
        name, durations=lengths, seed=seed, making=making, inputs=inputs, noise=std, start=region
    )
