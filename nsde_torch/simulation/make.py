"""Plants by the name of their system."""

from __future__ import annotations

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
from nsde_torch.simulation.plant import Plant
from nsde_torch.systems import System
from nsde_torch.systems.machines import Effects, machine, make_plant_system


@dataclass(frozen=True)
class Making:
    """The plant of a recording; None takes the machine's own.

    Args:
        effects: Effects beyond those that the plant has: `name` or `{name: {parameter: value}}`.
        process_noise: Factor on the machine's gusts.
        sensor_noise: Factor on the machine's sensor noise.
        declared_only: Leave out the effects that the declared physics does not have.
        latency: Time from a command to its effect [s].
        dt: Sample [s].
        step: Fine step of the integration [s].
        battery: Log the voltage of a battery though no effect reads it (multirotors).
        values: Parameters of the declared physics in place of the machine's.
    """

    effects: Effects = ()
    process_noise: float = 1.0
    sensor_noise: float = 1.0
    declared_only: bool = False
    latency: float | None = None
    dt: float | None = None
    step: float | None = None
    battery: bool = False
    values: Mapping[str, Any] | None = None

    def sample(self, name: str) -> float:
        """Sample of the plant of a system [s]."""
        return self.dt or machine(name).dt

    def plant(
        self, name: str, *, generator: torch.Generator, sensor_std: Sequence[float] | None = None
    ) -> Plant:
        """The plant of a system; arguments and errors are those of `make_plant`."""
        settings = {k: v for k, v in vars(self).items() if k != "battery"}
        return make_plant(name, generator=generator, sensor_std=sensor_std, **settings)


def noise_generator(seed: int, stream: int) -> torch.Generator:
    """Random numbers of a plant's noise, apart from those that are drawn of the same seed for other things."""
    return torch.Generator().manual_seed(int(np.random.default_rng([seed, stream]).integers(2**62)))


@torch.no_grad()
def _longest_step(system: System) -> float:
    """The longest step that follows a system from rest: half the time of its fastest mode there [s].

    Rest is where smoothed friction is stiffest; lags and delays are as fast everywhere.
    """
    system = copy.deepcopy(system).double()
    x = torch.zeros(1, system.nx, dtype=torch.float64)
    if system.quaternion is not None:
        x[:, system.quaternion.start] = 1.0
    u = torch.zeros(1, system.nu + len(system.exogenous), dtype=torch.float64)

    def rate(z: torch.Tensor) -> torch.Tensor:
        return system.drift(0.0, z, u)[0]

    # row by row: torch takes a second to load what it differentiates forward with
    slopes = torch.autograd.functional.jacobian(rate, system.augment(x, u))[:, 0]
    if not bool(torch.isfinite(slopes).all()):
        return inf
    fastest = float(torch.linalg.eigvals(slopes).abs().max())
    return 0.5 / fastest if fastest > 0 else inf


def make_plant(
    name: str,
    *,
    generator: torch.Generator,
    effects: Effects = (),
    declared_only: bool = False,
    process_noise: float = 1.0,
    sensor_noise: float = 1.0,
    latency: float | None = None,
    dt: float | None = None,
    step: float | None = None,
    check: bool = True,
    dtype: torch.dtype = torch.float64,
    values: Mapping[str, Any] | None = None,
    sensor_std: Sequence[float] | None = None,
) -> Plant:
    """The plant of a system.

    Args:
        name: Name of the system.
        generator: Source of all randomness; it also sets the device.
        step: Fine step [s]; None: the machine's, or less to fit into `dt` and to follow the fastest effect.
        check: Raise when a state is not finite.
        dtype: Precision.
        sensor_std: Noise of each error channel in place of the machine's.
        effects, declared_only, process_noise, sensor_noise, latency, dt, values: See `Making`.

    Raises:
        ConfigError: no plant of that name, an unknown effect or parameter, or a number out of range.

    Example:
        >>> plant = make_plant("hexacopter", generator=torch.Generator().manual_seed(0),
        effects=["quadratic_drag"])
    """
    spec = machine(name)
    if not spec.gusts and process_noise not in (0.0, 1.0):
        raise ConfigError(
            f"the plant of {name!r} has no process noise that `process_noise` could scale; got "
            f"{process_noise!r}. Leave it at 1."
        )
    sample = spec.dt if dt is None else dt
    system = make_plant_system(name, effects=effects, declared_only=declared_only, values=values)
    if step is None:
        step = sample / max(1, ceil(sample / min(spec.step, _longest_step(system)) - 1e-6))
    return Plant(
        system,
        dt=sample,
        generator=generator,
        step=step,
        gusts=spec.gusts,
        sensor_std=spec.sensor_std if sensor_std is None else tuple(sensor_std),
        process_noise=process_noise,
        sensor_noise=sensor_noise,
        latency=spec.latency if latency is None else latency,
        limits=spec.limits,
        check=check,
        dtype=dtype,
    )


Control = Callable[[float, torch.Tensor], torch.Tensor]


def record(
    plant: Plant, start: Array, control: Control, *, durations: Sequence[float], prefix: str
) -> list[RawRun]:
    """Runs of a plant under a controller.

    Args:
        plant: The machines.
        start: First true states (B, nx).
        control: Commands (B, nu) from the time [s] and the measured states (B, nx).
        durations: Length of each run [s], at least one sample.
        prefix: Runs are named `prefix_0`, `prefix_1`, ...

    Returns:
        One run for each row: measured states, and the command given at each, which holds to the next.

    Raises:
        ConfigError: no duration, or one shorter than a sample.
    """
    if not len(durations) or min(durations) < plant.dt:
        raise ConfigError(
            f"`durations` must be one or more times of {plant.dt:g} s or longer; got {list(durations)}."
        )
    rows = [round(d / plant.dt) + 1 for d in durations]
    x = plant.reset(torch.as_tensor(start), torch.zeros(len(start), plant.system.nu))
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
    """Refuse durations that are no times, a seed that is none, and factors below 0.

    Raises:
        ConfigError: names the number.
    """
    if durations is not None and not (len(durations) and all(isfinite(d) and d > 0 for d in durations)):
        raise ConfigError(f"`durations` must be one or more times above 0 s; got {list(durations)}.")
    if isinstance(seed, bool) or int(seed) != seed or seed < 0:
        raise ConfigError(f"`seed` must be a whole number of 0 or more; got {seed!r}.")
    for name, value in factors.items():
        if not (isfinite(value) and value >= 0):
            raise ConfigError(f"`{name}` must be a factor of 0 or more; got {value!r}.")
