"""Machines that policies learn on: a learned model, and the truth.

A neural SDE is stepped by its own integrator, and each path keeps its memory and its disturbance from one sample
to the next. A machine of an ensemble keeps the member that it drew at the start of its episode ("fixed"), or draws one
at every sample ("redrawn"), as the paths of the ensemble do. Any other model is asked for one step of `sample` at a
time from the state that it predicted. The state evolves without sensor noise; the noise that a model has learned of
its sensors is added to what is measured.
"""

from abc import abstractmethod
from typing import final

import torch
from torch import Tensor

from nsde_torch.errors import ConfigError
from nsde_torch.models.ensemble import PROPAGATIONS, GaussianEnsemble
from nsde_torch.models.model import Model, has_members, is_equation, normal
from nsde_torch.models.neural_sde import NeuralSDE
from nsde_torch.policy.environment import Dynamics
from nsde_torch.sde import brownian, rollout
from nsde_torch.simulation import make_plant
from nsde_torch.simulation.plant import Sensor
from nsde_torch.systems import make_plant_system

# The true cart and pole: the package's plant, or the machine that the published data came from.
#
# `plant` integrates the equations of motion by Runge-Kutta 4 in steps of 5 ms, pushed by weak gusts, and
# measures with a tenth of the published noise. `published` is explicit Euler at 50 Hz without gusts; the
# variances of its sensors, [0.005, 0.01, 0.009, 0.05], are those of the public code that belongs to the
# supplement, and are found in its data (standard deviations of the residuals of kinematics and physics: 0.070
# m, 0.100 m/s, 0.095 rad, 0.22 rad/s).

TRUTHS = ("plant", "published")
PUBLISHED_VARIANCES = (0.005, 0.01, 0.009, 0.05)


def make_truth(
    name: str, *, system: str, dt: float, sensor_noise: float, generator: torch.Generator
) -> Dynamics:
    """The true machines of a system, one of `TRUTHS`, with a sample of `dt` [s] and a factor on the sensor noise.

    ConfigError: no such truth, or none of this system.
    """
    if name not in TRUTHS:
        raise ConfigError(f"`truth` must be one of {', '.join(TRUTHS)}; got {name!r}.")
    if name == "published" and system != "cartpole":
        raise ConfigError(f"`truth=published` is known of cartpole alone; got {system!r}. Take truth=plant.")
    if name == "published":
        return PublishedCartpole(system, dt=dt, sensor_noise=sensor_noise, generator=generator)
    return make_plant(system, check=False, dt=dt, sensor_noise=sensor_noise, generator=generator)


class _Rows(Dynamics):
    """Machines that are nothing but the rows of a tensor, each its state first."""

    _x: Tensor
    _nx: int

    @property
    def state(self) -> Tensor:
        return self._x[:, : self._nx]

    def reset(self, x0: Tensor) -> Tensor:
        self._x = self._started(x0)
        return self._measured(self.state)

    def restart(self, rows: Tensor, x0: Tensor) -> Tensor:
        fresh = self._started(x0)
        self._x = self._x.index_copy(0, rows, fresh)
        return self._measured(fresh[:, : self._nx])

    @abstractmethod
    def _started(self, x0: Tensor) -> Tensor:
        """Rows of machines that start in the states (K, nx)."""

    def _measured(self, x: Tensor) -> Tensor:
        return x


@final
class PublishedCartpole(_Rows):
    """The cart and pole of the published data; arguments are those of `make_truth`."""

    def __init__(self, system: str, *, dt: float, sensor_noise: float, generator: torch.Generator) -> None:
        self.system = make_plant_system(system, declared_only=True).double().requires_grad_(False)
        self._dt = dt
        std = tuple(variance**0.5 for variance in PUBLISHED_VARIANCES)
        self._sensor = Sensor(self.system, std, scale=sensor_noise, generator=generator)
        self._nx = self.system.nx

    def _started(self, x0: Tensor) -> Tensor:
        return x0.double()

    def _measured(self, x: Tensor) -> Tensor:
        return self._sensor(x)

    @torch.no_grad()
    def step(self, u: Tensor) -> Tensor:
        self._x = self._x + self._dt * self.system.drift(0.0, self._x, u.double())
        return self._sensor(self._x)


def make_learned(
    model: Model,
    *,
    dt: float,
    sensor_noise: float,
    generator: torch.Generator,
    propagation: str | None = None,
) -> Dynamics:
    """The machines that a model has learned, with a sample of `dt` [s] and a factor on the sensor noise it has learned.

    `propagation` is that of the members of an ensemble, "fixed" or "redrawn"; None takes what it was trained with.
    ConfigError: the factor is below 0, `dt` is not the step of an ensemble, or `propagation` is unknown or given for a
    model that has no members.
    """
    if not sensor_noise >= 0:
        raise ConfigError(f"`sensor_noise` must be a factor of 0 or more; got {sensor_noise!r}.")
    if has_members(model):
        return _EnsembleDynamics(model, dt=dt, generator=generator, propagation=propagation)
    if propagation is not None:
        raise ConfigError(
            f"`propagation={propagation}` chooses members of an ensemble, and this model is {model.spec.kind}. "
            "Leave it out."
        )
    if is_equation(model):
        return _SDEDynamics(model, dt=dt, sensor_noise=sensor_noise, generator=generator)
    return _SampledDynamics(model, dt=dt, generator=generator)


class _SampledDynamics(_Rows):
    """A model through `sample` with one step, where it has no better way."""

    def __init__(self, model: Model, *, dt: float, generator: torch.Generator) -> None:
        self.model = model
        self._dt, self._generator = dt, generator
        self._x, self._nx = model.clock_scale.new_empty(0, model.system.nx), model.system.nx

    def _started(self, x0: Tensor) -> Tensor:
        return self.model.project(x0.to(self._x))

    @torch.no_grad()
    def step(self, u: Tensor) -> Tensor:
        path = self.model.sample(
            self._x,
            u.to(self._x)[:, None],
            dt=self._dt,
            particles=1,
            generator=self._generator,
            measurement=False,
            applied=True,
        )
        self._x = path[0, :, 1]
        return self._x


@final
class _SDEDynamics(_SampledDynamics):
    """A neural SDE, stepped by its integrator; rows go on with its memory and disturbance."""

    model: NeuralSDE

    def __init__(
        self, model: NeuralSDE, *, dt: float, sensor_noise: float, generator: torch.Generator
    ) -> None:
        super().__init__(model, dt=dt, generator=generator)
        self._std = sensor_noise * model.measurement_std
        self._noisy = bool((self._std > 0).any())

    @torch.no_grad()
    def step(self, u: Tensor) -> Tensor:
        z, step = self._x, self.model.step
        noise = None
        if not step.deterministic:
            made = {"generator": self._generator, "device": z.device, "dtype": z.dtype}
            noise = brownian(1, len(z), 1, z.shape[1], dt=self._dt, **made)  # type: ignore[arg-type]
        path = rollout(self.model, z, u.to(z)[:, None], dt=self._dt, step=step, noise=noise, check=False)
        self._x = path[0, :, 1]
        return self._measured(self.state)

    @torch.no_grad()
    def _started(self, x0: Tensor) -> Tensor:
        model = self.model
        x = model.project(x0.to(self._x))
        draw = normal((len(x), model.nd), self._generator, x) if model.nd else None
        return model.augment(x, x.new_zeros(len(x), model.system.nu + len(model.system.exogenous)), draw)

    def _measured(self, x: Tensor) -> Tensor:
        if not self._noisy:
            return x
        return self.model.project(x + self._std * normal(tuple(x.shape), self._generator, x))


@final
class _EnsembleDynamics(_SampledDynamics):
    """A Gaussian ensemble; every machine moves by its own member."""

    model: GaussianEnsemble

    def __init__(
        self, model: GaussianEnsemble, *, dt: float, generator: torch.Generator, propagation: str | None
    ) -> None:
        propagation = model.spec.propagation if propagation is None else propagation
        if propagation not in PROPAGATIONS:
            raise ConfigError(f"`propagation` must be {' or '.join(PROPAGATIONS)}; got {propagation!r}.")
        if not abs(dt / model.spec.dt - 1) < 1e-6:
            raise ConfigError(
                f"`environment` is an ensemble that learned steps of {model.spec.dt:g} s and knows no other; the task "
                f"has steps of {dt:g} s. Train another with system.dt={dt:g}."
            )
        super().__init__(model, dt=dt, generator=generator)
        self._redrawn = propagation == "redrawn"
        self.members = torch.empty(0, dtype=torch.long, device=self._x.device)
        """The member that moved each machine last, or moves it next after a start (N,)."""

    def reset(self, x0: Tensor) -> Tensor:
        self.members = self.model.draw_members(len(x0), self._generator)
        return super().reset(x0)

    def restart(self, rows: Tensor, x0: Tensor) -> Tensor:
        drawn = self.model.draw_members(len(rows), self._generator)
        self.members = self.members.index_copy(0, rows, drawn)
        return super().restart(rows, x0)

    @torch.no_grad()
    def step(self, u: Tensor) -> Tensor:
        if self._redrawn:
            self.members = self.model.draw_members(len(self._x), self._generator)
        noise = normal((len(self._x), self.model.chart.n_change), self._generator, self._x)
        self._x = self.model.advance(self._x, u.to(self._x), self.members, noise)
        return self._x
