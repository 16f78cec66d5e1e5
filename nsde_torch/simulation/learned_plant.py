"""A learned model in the place of the machine: paths of its equation, noise and lasting disturbances included."""

from dataclasses import KW_ONLY, dataclass
from typing import final

import torch
from torch import Tensor

from nsde_torch.errors import ConfigError
from nsde_torch.models import Model
from nsde_torch.models.model import is_equation
from nsde_torch.sde import make_step
from nsde_torch.simulation.plant import Sensor
from nsde_torch.systems.machine import Limits, ends_of


@final
@dataclass(eq=False)
class LearnedPlant:
    """Machines that move as a neural SDE says; a ConfigError for another model, or limits of other inputs."""

    model: Model
    _: KW_ONLY
    dt: float  # this and what follows: see `Plant`
    generator: torch.Generator
    sensor_std: tuple[float, ...] | None = None
    process_noise: float = 1.0  # factor on the diffusion
    sensor_noise: float = 1.0
    latency: float = 0.0  # time from a command to its effect [s], rounded to samples
    limits: Limits | None = (0.0, 1.0)

    def __post_init__(self) -> None:
        model = self.model
        if not is_equation(model):
            raise ConfigError(
                f"`plant=learned` flies a model of kind nsde, node or blackbox_nsde; got {model.spec.kind!r}."
            )
        self._sde, self._step = model, model.step if not model.step.deterministic else make_step("rk4")
        self._delay = round(self.latency / self.dt)
        ends = () if self.limits is None else ends_of(self.limits, model.system.input_names)
        self._limits = [model.clock_scale.new_tensor(end) for end in ends]
        std = (0.0,) * len(model.system.error_names) if self.sensor_std is None else self.sensor_std
        self._sensor = Sensor(model.system, std, scale=self.sensor_noise, generator=self.generator)
        self._z, self._commands = torch.empty(0), [torch.empty(0)]
        self._samples = 0

    @property
    def state(self) -> Tensor:
        """True states (N, nx)."""
        return self._z[:, : self._sde.system.nx].double()

    @torch.no_grad()
    def reset(self, x0: Tensor, u0: Tensor) -> Tensor:
        """See `Plant.reset`."""
        x, u = x0.to(self._sde.clock_scale), u0.to(self._sde.clock_scale)
        draw = torch.randn(len(x), self._sde.nd, generator=self.generator).to(x) * self.process_noise
        self._z = self._sde.project(self._sde.augment(x, u, draw if self._sde.nd else None))
        self._commands = [u] * (1 + self._delay)
        self._samples = 0
        return self._sensor(self.state)

    @torch.no_grad()
    def step(self, u: Tensor) -> Tensor:
        """See `Plant.step`."""
        m = self._sde
        u = u.to(m.clock_scale)
        self._commands = [*self._commands[1:], u.clamp(*self._limits) if self._limits else u]
        # a sample of physical time is 1 / clock_scale samples of the model's clock
        dt = self.dt / float(m.clock_scale)
        m.set_step(dt)
        dw = torch.randn(self._z.shape, generator=self.generator).to(self._z) * (self.process_noise * dt**0.5)
        t = self._samples * dt
        noise = None if self._step.deterministic else dw
        self._z = m.project(self._step.advance(m, t, self._z, self._commands[0], dt, noise))
        self._samples += 1
        return self._sensor(self.state)
