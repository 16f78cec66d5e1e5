"""A learned model as a machine that is pushed a sample at a time.

A neural SDE is stepped by its own integrator, and each path keeps its memory and its disturbance from one sample
to the next. A machine of an ensemble keeps the member that it drew at the start of its episode ("fixed"), or draws one
at every sample ("redrawn"), as the paths of the ensemble do. Any other model is asked for one step of `sample` at a
time from the state that it predicted. The state evolves without sensor noise; the noise that a model has learned of
its sensors is added to what is measured.
"""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from nsde_torch.errors import ConfigError
from nsde_torch.models.capabilities import has_members, is_equation
from nsde_torch.models.ensemble import PROPAGATIONS, GaussianEnsemble
from nsde_torch.models.model import Model, normal
from nsde_torch.models.neural_sde import NeuralSDE
from nsde_torch.policy.dynamics import Dynamics
from nsde_torch.sde import brownian, rollout


def make_learned(
    model: Model,
    *,
    dt: float,
    sensor_noise: float,
    generator: torch.Generator,
    propagation: str | None = None,
) -> Dynamics:
    """The machines that a model has learned.

    Args:
        model: The model.
        dt: Sample [s].
        sensor_noise: Factor on the sensor noise that the model has learned, >= 0; one without such noise has none.
        generator: Source of all randomness.
        propagation: "fixed" or "redrawn" members of an ensemble; None takes what the ensemble was trained with.

    Raises:
        ConfigError: the factor is below 0, `dt` is not the step of an ensemble, or `propagation` is unknown or given
            for a model that has no members.
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
    made = _SDEDynamics if is_equation(model) else _SampledDynamics
    return made(model, dt=dt, sensor_noise=sensor_noise, generator=generator)  # type: ignore[arg-type]


@final
class _SDEDynamics(Dynamics):
    """A neural SDE, stepped by its integrator."""

    def __init__(
        self,
        model: NeuralSDE,
        *,
        dt: float,
        sensor_noise: float,
        generator: torch.Generator,
    ) -> None:
        self.model, self.name = model, model.spec.kind
        self._dt, self._generator = dt, generator
        self._std = sensor_noise * model.measurement_std
        self._noisy = bool((self._std > 0).any())
        self._z = model.clock_scale.new_empty(0, model.nz)

    @property
    def state(self) -> Tensor:
        """See `Dynamics.state`."""
        return self._z[:, : self.model.system.nx]

    def reset(self, x0: Tensor) -> Tensor:
        """See `Dynamics.reset`."""
        self._z = self._start(x0)
        return self._measured(self.state)

    def restart(self, rows: Tensor, x0: Tensor) -> Tensor:
        """See `Dynamics.restart`."""
        z = self._start(x0)
        self._z = self._z.index_copy(0, rows, z)
        return self._measured(z[:, : self.model.system.nx])

    @torch.no_grad()
    def step(self, u: Tensor) -> Tensor:
        """See `Dynamics.step`."""
        z, step = self._z, self.model.step
        noise = None
        if not step.deterministic:
            made = {"generator": self._generator, "device": z.device, "dtype": z.dtype}
            noise = brownian(1, len(z), 1, z.shape[1], dt=self._dt, **made)  # type: ignore[arg-type]
        path = rollout(
            self.model,
            z,
            u.to(z)[:, None],
            dt=self._dt,
            step=step,
            noise=noise,
            check=False,
        )
        self._z = path[0, :, 1]
        return self._measured(self.state)

    @torch.no_grad()
    def _start(self, x0: Tensor) -> Tensor:
        model = self.model
        x = model.project(x0.to(self._z))
        draw = normal((len(x), model.nd), self._generator, x) if model.nd else None
        return model.augment(x, x.new_zeros(len(x), model.system.nu + len(model.system.exogenous)), draw)

    def _measured(self, x: Tensor) -> Tensor:
        if not self._noisy:
            return x
        return self.model.project(x + self._std * normal(tuple(x.shape), self._generator, x))


@final
class _EnsembleDynamics(Dynamics):
    """A Gaussian ensemble; every machine moves by its own member."""

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
        self.model, self.name = model, model.spec.kind
        self._generator, self._redrawn = generator, propagation == "redrawn"
        self._x = model.clock_scale.new_empty(0, model.system.nx)
        self._members = torch.empty(0, dtype=torch.long, device=self._x.device)

    @property
    def state(self) -> Tensor:
        """See `Dynamics.state`."""
        return self._x

    @property
    def members(self) -> Tensor:
        """The member that moved each machine last, or moves it next after a start (N,)."""
        return self._members

    def reset(self, x0: Tensor) -> Tensor:
        """See `Dynamics.reset`."""
        self._x = self.model.project(x0.to(self._x))
        self._members = self.model.draw_members(len(x0), self._generator)
        return self._x

    def restart(self, rows: Tensor, x0: Tensor) -> Tensor:
        """See `Dynamics.restart`."""
        x = self.model.project(x0.to(self._x))
        self._x = self._x.index_copy(0, rows, x)
        drawn = self.model.draw_members(len(rows), self._generator)
        self._members = self._members.index_copy(0, rows, drawn)
        return x

    @torch.no_grad()
    def step(self, u: Tensor) -> Tensor:
        """See `Dynamics.step`."""
        if self._redrawn:
            self._members = self.model.draw_members(len(self._x), self._generator)
        noise = normal((len(self._x), self.model.chart.n_change), self._generator, self._x)
        self._x = self.model.advance(self._x, u.to(self._x), self._members, noise)
        return self._x


@final
class _SampledDynamics(Dynamics):
    """Any other model, through `sample` with one step."""

    def __init__(
        self,
        model: Model,
        *,
        dt: float,
        sensor_noise: float,
        generator: torch.Generator,
    ) -> None:
        self.model, self.name = model, model.spec.kind
        self._dt, self._generator = dt, generator
        self._x = model.clock_scale.new_empty(0, model.system.nx)

    @property
    def state(self) -> Tensor:
        """See `Dynamics.state`."""
        return self._x

    def reset(self, x0: Tensor) -> Tensor:
        """See `Dynamics.reset`."""
        self._x = self.model.project(x0.to(self._x))
        return self._x

    def restart(self, rows: Tensor, x0: Tensor) -> Tensor:
        """See `Dynamics.restart`."""
        x = self.model.project(x0.to(self._x))
        self._x = self._x.index_copy(0, rows, x)
        return x

    @torch.no_grad()
    def step(self, u: Tensor) -> Tensor:
        """See `Dynamics.step`."""
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
