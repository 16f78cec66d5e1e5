"""The true cart and pole: the package's plant, or the machine that the published data came from.

`plant` integrates the equations of motion by Runge-Kutta 4 in steps of 5 ms, pushed by weak gusts, and measures
with a tenth of the published noise. `published` is explicit Euler at 50 Hz without gusts; the variances of its
sensors, [0.005, 0.01, 0.009, 0.05], are those of the public code that belongs to the supplement, and are found in
its data (standard deviations of what kinematics and physics leave over: 0.070 m, 0.100 m/s, 0.095 rad, 0.22 rad/s).
"""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from nsde_torch.errors import ConfigError
from nsde_torch.policy.dynamics import Dynamics
from nsde_torch.simulation import make_plant
from nsde_torch.simulation.noise import Sensor
from nsde_torch.systems import make_plant_system

TRUTHS = ("plant", "published")
PUBLISHED_VARIANCES = (0.005, 0.01, 0.009, 0.05)


def make_truth(
    name: str, *, system: str, dt: float, sensor_noise: float, generator: torch.Generator
) -> Dynamics:
    """The true machines.

    Args:
        name: One of `TRUTHS`.
        system: Which machine.
        dt: Sample [s].
        sensor_noise: Factor on the sensor noise, >= 0.
        generator: Source of all randomness.

    Raises:
        ConfigError: no such truth, or none of this system.
    """
    if name not in TRUTHS:
        raise ConfigError(f"`truth` must be one of {', '.join(TRUTHS)}; got {name!r}.")
    if name == "published" and system != "cartpole":
        raise ConfigError(f"`truth=published` is known of cartpole alone; got {system!r}. Take truth=plant.")
    made = PublishedCartpole if name == "published" else PlantDynamics
    return made(system, dt=dt, sensor_noise=sensor_noise, generator=generator)


@final
class PlantDynamics(Dynamics):
    """A plant of the package.

    Args:
        system: Which machine.
        dt: Sample [s].
        sensor_noise: Factor on the plant's sensor noise, >= 0.
        generator: Source of all randomness.
        process_noise: Factor on the plant's gusts, >= 0.
    """

    name = "plant"

    def __init__(
        self,
        system: str,
        *,
        dt: float,
        sensor_noise: float,
        generator: torch.Generator,
        process_noise: float = 1.0,
    ) -> None:
        self.plant = make_plant(
            system,
            generator=generator,
            dt=dt,
            sensor_noise=sensor_noise,
            process_noise=process_noise,
            check=False,
        )
        self._width = self.plant.system.nu + len(self.plant.system.exogenous)

    @property
    def state(self) -> Tensor:
        """See `Dynamics.state`."""
        return self.plant.state

    def reset(self, x0: Tensor) -> Tensor:
        """See `Dynamics.reset`."""
        return self.plant.reset(x0, x0.new_zeros(len(x0), self._width))

    def restart(self, rows: Tensor, x0: Tensor) -> Tensor:
        """See `Dynamics.restart`."""
        return self.plant.restart(rows, x0, x0.new_zeros(len(x0), self._width))

    def step(self, u: Tensor) -> Tensor:
        """See `Dynamics.step`."""
        return self.plant.step(u)


@final
class PublishedCartpole(Dynamics):
    """The cart and pole of the published data.

    Args:
        system: Which machine.
        dt: Sample, which is the step of Euler's method [s].
        sensor_noise: Factor on the published sensor noise, >= 0.
        generator: Source of all randomness.
    """

    name = "published"

    def __init__(self, system: str, *, dt: float, sensor_noise: float, generator: torch.Generator) -> None:
        self.system = make_plant_system(system, declared_only=True).double().requires_grad_(False)
        self._dt = dt
        std = tuple(variance**0.5 for variance in PUBLISHED_VARIANCES)
        self._sensor = Sensor(self.system, std, scale=sensor_noise, generator=generator, dtype=torch.float64)
        self._x = torch.empty(0, self.system.nx, dtype=torch.float64)

    @property
    def state(self) -> Tensor:
        """See `Dynamics.state`."""
        return self._x

    def reset(self, x0: Tensor) -> Tensor:
        """See `Dynamics.reset`."""
        self._x = x0.double()
        return self._sensor(self._x)

    def restart(self, rows: Tensor, x0: Tensor) -> Tensor:
        """See `Dynamics.restart`."""
        x = x0.double()
        self._x = self._x.index_copy(0, rows, x)
        return self._sensor(x)

    @torch.no_grad()
    def step(self, u: Tensor) -> Tensor:
        """See `Dynamics.step`."""
        self._x = self._x + self._dt * self.system.drift(0.0, self._x, u.double())
        return self._sensor(self._x)
