"""A learned model in the place of the machine: paths of its equation, noise and lasting disturbances included."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from nsde_torch.errors import ConfigError
from nsde_torch.models import Model
from nsde_torch.models.capabilities import is_equation
from nsde_torch.sde import make_step
from nsde_torch.simulation.noise import Sensor
from nsde_torch.systems.machine import Limits, ends_of


@final
class LearnedPlant:
    """Machines that move as a neural SDE says.

    Args:
        model: The model.
        process_noise: Factor on the diffusion.
        latency: Time from a command to its effect [s], rounded to samples.
        dt, generator, sensor_std, sensor_noise, limits: See `Plant`.

    Raises:
        ConfigError: the model is no neural SDE, or limits of another number of inputs.
    """

    def __init__(
        self,
        model: Model,
        *,
        dt: float,
        generator: torch.Generator,
        sensor_std: tuple[float, ...] | None = None,
        process_noise: float = 1.0,
        sensor_noise: float = 1.0,
        latency: float = 0.0,
        limits: Limits | None = (0.0, 1.0),
    ) -> None:
        if not is_equation(model):
            raise ConfigError(
                f"`plant=learned` flies a model of kind nsde, node or blackbox_nsde; got {model.spec.kind!r}."
            )
        self.model, self.dt, self._generator = model, dt, generator
        self._step = model.step if not model.step.deterministic else make_step("rk4")
        self._noise, self._delay = process_noise, round(latency / dt)
        ends = () if limits is None else ends_of(limits, model.system.input_names)
        self._limits = [model.clock_scale.new_tensor(end) for end in ends]
        std = (0.0,) * len(model.system.error_names) if sensor_std is None else sensor_std
        self._sensor = Sensor(model.system, std, scale=sensor_noise, generator=generator)
        self._z, self._commands = torch.empty(0), [torch.empty(0)]
        self._samples = 0

    @property
    def state(self) -> Tensor:
        """True states (N, nx)."""
        return self._z[:, : self.model.system.nx].double()

    @torch.no_grad()
    def reset(self, x0: Tensor, u0: Tensor) -> Tensor:
        """See `Plant.reset`."""
        x, u = x0.to(self.model.clock_scale), u0.to(self.model.clock_scale)
        draw = torch.randn(len(x), self.model.nd, generator=self._generator).to(x) * self._noise
        self._z = self.model.project(self.model.augment(x, u, draw if self.model.nd else None))
        self._commands = [u] * (1 + self._delay)
        self._samples = 0
        return self._sensor(self.state)

    @torch.no_grad()
    def step(self, u: Tensor) -> Tensor:
        """See `Plant.step`."""
        m = self.model
        u = u.to(m.clock_scale)
        self._commands = [*self._commands[1:], u.clamp(*self._limits) if self._limits else u]
        # a sample of physical time is 1 / clock_scale samples of the model's clock
        dt = self.dt / float(m.clock_scale)
        m.set_step(dt)
        dw = torch.randn(self._z.shape, generator=self._generator).to(self._z) * (self._noise * dt**0.5)
        t = self._samples * dt
        noise = None if self._step.deterministic else dw
        self._z = m.project(self._step.advance(m, t, self._z, self._commands[0], dt, noise))
        self._samples += 1
        return self._sensor(self.state)
