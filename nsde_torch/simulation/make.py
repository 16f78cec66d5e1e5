"""Plants by the name of their system."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, inf, isfinite
from types import MappingProxyType
from typing import Any

import numpy as np
import torch

from nsde_torch.arrays import Array
from nsde_torch.data.raw import RawRun
from nsde_torch.errors import ConfigError
from nsde_torch.models.networks import at_zero
from nsde_torch.simulation.plant import Plant
from nsde_torch.systems import System
from nsde_torch.systems.machines import Effects, machine, make_plant_system


@dataclass(frozen=True)
class Making:
    """The plant of a recording; None takes the machine's own."""

    effects: Effects = ()  # effects beyond those that the plant has: `name` or `{name: {parameter: value}}`
    process_noise: float = 1.0  # factor on the machine's gusts
    sensor_noise: float = 1.0  # factor on the machine's sensor noise
    declared_only: bool = False  # leave out the effects that the declared physics does not have
    latency: float | None = None  # time from a command to its effect [s]
    dt: float | None = None  # sample [s]
    step: float | None = None
    """Fine step of the integration [s]; None: the machine's, or less to fit into `dt` and follow the fastest effect."""
    battery: bool = False  # log the voltage of a battery though no effect reads it (multirotors)
    values: Mapping[str, Any] | None = None  # parameters of the declared physics in place of the machine's

    def sample(self, name: str) -> float:
        """Sample of the plant of a system [s]."""
        return self.dt or machine(name).dt

    def plant(
        self,
        name: str,
        *,
        generator: torch.Generator,
        sensor_std: Sequence[float] | None = None,
        check: bool = True,
    ) -> Plant:
        """The plant of a system; `generator` and `check` are those of `Plant`.

        `sensor_std` is the noise of each error channel in place of the machine's. A ConfigError where there is no plant
        of that name, an effect or parameter is unknown, or a number out of range.
        """
        spec = machine(name)
        if not spec.gusts and self.process_noise not in (0.0, 1.0):
            raise ConfigError(
                f"the plant of {name!r} has no process noise that `process_noise` could scale; got "
                f"{self.process_noise!r}. Leave it at 1."
            )
        sample, step = self.sample(name), self.step
        system = make_plant_system(
            name, effects=self.effects, declared_only=self.declared_only, values=self.values
        )
        if step is None:
            step = sample / max(1, ceil(sample / min(spec.step, _longest_step(system)) - 1e-6))
        return Plant(
            system,
            dt=sample,
            generator=generator,
            step=step,
            gusts=spec.gusts,
            sensor_std=spec.sensor_std if sensor_std is None else tuple(sensor_std),
            process_noise=self.process_noise,
            sensor_noise=self.sensor_noise,
            latency=spec.latency if self.latency is None else self.latency,
            limits=spec.limits,
            check=check,
        )


def make_plant(name: str, *, generator: torch.Generator, check: bool = True, **settings: Any) -> Plant:
    """The plant of a system: settings are those of `Making`, and `sensor_std` of `Making.plant`.

    Example:
        >>> g = torch.Generator().manual_seed(0)
        >>> plant = make_plant("hexacopter", generator=g, effects=["quadratic_drag"])
    """
    std = settings.pop("sensor_std", None)
    return Making(**settings).plant(name, generator=generator, check=check, sensor_std=std)


def noise_generator(seed: int, stream: int) -> torch.Generator:
    """Random numbers of a plant's noise, apart from those that are drawn of the same seed for other things."""
    return torch.Generator().manual_seed(int(np.random.default_rng([seed, stream]).integers(2**62)))


@torch.no_grad()
def _longest_step(system: System) -> float:
    """The longest step that follows a system from rest: half the time of its fastest mode there [s].

    Rest is where smoothed friction is stiffest; lags and delays are as fast everywhere.
    """
    system = copy.deepcopy(system).double()
    x = at_zero(system).double()
    u = x.new_zeros(1, system.nu + len(system.exogenous))

    def rate(z: torch.Tensor) -> torch.Tensor:
        return system.drift(0.0, z, u)[0]

    # row by row: torch takes a second to load what it differentiates forward with
    slopes = torch.autograd.functional.jacobian(rate, system.augment(x, u))[:, 0]
    if not bool(torch.isfinite(slopes).all()):
        return inf
    fastest = float(torch.linalg.eigvals(slopes).abs().max())
    return 0.5 / fastest if fastest > 0 else inf


Control = Callable[[float, torch.Tensor], torch.Tensor]


def record(
    plant: Plant, start: Array, control: Control, *, durations: Sequence[float], prefix: str
) -> list[RawRun]:
    """Runs of a plant under a controller, `prefix_0` and so on: measured states, and the command given at each.

    From true states (B, nx), with commands (B, nu) of the time [s] and the measured states (B, nx). A ConfigError where
    there is no duration [s], or one shorter than a sample.
    """
    if not len(durations) or min(durations) < plant.dt:
        raise ConfigError(
            f"`durations` must be one or more times of {plant.dt:g} s or longer; got {list(durations)}."
        )
    rows = [round(d / plant.dt) + 1 for d in durations]
    x = plant.reset(torch.as_tensor(start))
    states, commands = [x], []
    for k in range(max(rows)):
        u = control(k * plant.dt, x)
        commands.append(u)
        if k + 1 < max(rows):
            x = plant.step(u)
            states.append(x)
    xs, us = torch.stack(states).cpu().numpy(), torch.stack(commands).cpu().numpy()
    digits = len(str(len(rows) - 1))
    return [
        simulated_run(f"{prefix}_{i:0{digits}d}", plant.dt, xs[:n, i].copy(), us[:n, i].copy())
        for i, n in enumerate(rows)
    ]


def simulated_run(
    name: str, dt: float, x: Array, u: Array, extra: Mapping[str, Array] = MappingProxyType({})
) -> RawRun:
    """A run that begins at 0: measured states, commands and further columns at every sample `dt` [s]."""
    t = dt * np.arange(len(x), dtype=np.float64)
    return RawRun(name, t, x, u, source="simulated", extra=dict(extra))


def check_numbers(durations: Sequence[float] | None, seed: int, **factors: float) -> None:
    """Refuse durations that are no times, a seed that is none, and factors below 0."""
    if durations is not None and not (len(durations) and all(isfinite(d) and d > 0 for d in durations)):
        raise ConfigError(f"`durations` must be one or more times above 0 s; got {list(durations)}.")
    if isinstance(seed, bool) or int(seed) != seed or seed < 0:
        raise ConfigError(f"`seed` must be a whole number of 0 or more; got {seed!r}.")
    for name, value in factors.items():
        if not (isfinite(value) and value >= 0):
            raise ConfigError(f"`{name}` must be a factor of 0 or more; got {value!r}.")
