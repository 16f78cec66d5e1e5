"""A plant: the simulated machine in place of the real one; it may hold effects that no model declares.

    dz/dt = system.drift(t, z, u(t - latency)) + gusts on the ports,        measured = x + sensor noise

The drift is integrated by Runge-Kutta 4 with a fine step inside each sample; gusts are held over a sample
(see `Gusts`). All rows of a batch advance at once: 256 closed loops cost little more than one.
"""

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass
from math import exp, sqrt
from typing import final

import torch
from torch import Tensor

from nsde_torch.effects import Effect, Port
from nsde_torch.errors import ConfigError, NonFiniteError, ShapeError
from nsde_torch.models.model import Model, is_equation
from nsde_torch.rotation import turned
from nsde_torch.sde import Time, WithoutNoise, make_step
from nsde_torch.systems import System
from nsde_torch.systems.machine import Gust, Limits, ends_of
from nsde_torch.systems.parameters import frozen

# Noise of a plant: gusts that push it and errors of its sensors.
#
# A port is pushed by g + w: g an Ornstein-Uhlenbeck process, dg = -g dt / tau + std sqrt(2 / tau) dW, sampled
# exactly,
#
#     g' = a g + std sqrt(1 - a^2) xi,   a = exp(-dt / tau),
#
# and w white, white * xi / sqrt(dt); both are held over a sample, so that the integral of w over a time T has
# the variance white^2 T whatever dt is. (Gillespie, Physical Review E 54, 1996, for the exact update.)


@final
@dataclass(eq=False)
class Gusts:
    """The gusts of one plant, advanced a sample at a time.

    A ConfigError refuses a port that the system lacks, or a time constant or scale out of range.
    """

    spec: Mapping[Port, Gust]  # gust of each port that has one
    widths: Mapping[Port, int]  # number of axes of each port of the system
    _: KW_ONLY
    dt: float  # sample [s]
    scale: float  # factor on everything, >= 0
    generator: torch.Generator  # source of all randomness; it also sets the device

    def __post_init__(self) -> None:
        if not self.scale >= 0:
            raise ConfigError(f"`process_noise` must be a factor of 0 or more; got {self.scale!r}.")
        self._parts: list[tuple[Port, int, float, Tensor, Tensor]] = []
        for port, gust in self.spec.items():
            if port not in self.widths:
                known = ", ".join(p.value for p in self.widths)
                raise ConfigError(
                    f"gusts act on the port {port.value!r}, which the system lacks; it has: {known}."
                )
            if not gust.time_constant > 0:
                raise ConfigError(f"`time_constant` of a gust must be > 0 s; got {gust.time_constant!r}.")
            width, keep = self.widths[port], exp(-self.dt / gust.time_constant)
            std, white = (self._row(v, width, port) * self.scale for v in (gust.std, gust.white))
            if self.scale > 0:
                self._parts.append((port, width, keep, std, white / sqrt(self.dt)))
        self._width = sum(width for _, width, *_ in self._parts)
        self._state: list[Tensor] = []

    def _row(self, values: tuple[float, ...], width: int, port: Port) -> Tensor:
        row = torch.tensor(values, dtype=torch.float64, device=self.generator.device)
        if row.numel() not in (1, width):
            raise ConfigError(f"a gust on {port.value!r} takes 1 or {width} numbers; got {row.numel()}.")
        return row.expand(width)

    def _normal(self, batch: int, columns: int) -> Tensor:
        device = self.generator.device
        return torch.randn(batch, columns, generator=self.generator, dtype=torch.float64, device=device)

    def reset(self, batch: int) -> None:
        """Start from the stationary distribution, for `batch` rows."""
        self._state = self._stationary(batch)

    def restart(self, rows: Tensor) -> None:
        """Start some rows (K,) from the stationary distribution, independent of their values before."""
        fresh = self._stationary(len(rows))
        self._state = [old.index_copy(0, rows, new) for old, new in zip(self._state, fresh, strict=True)]

    def _stationary(self, batch: int) -> list[Tensor]:
        draws = self._normal(batch, self._width).split([w for _, w, *_ in self._parts], 1)
        return [xi * std for xi, (_, _, _, std, _) in zip(draws, self._parts, strict=True)]

    def draw(self) -> dict[Port, Tensor]:
        """Push of each port over the next sample, (B, width of the port) [unit of the port]."""
        if not self._parts:
            return {}
        xi = self._normal(self._state[0].shape[0], 2 * self._width)
        out, at = {}, 0
        for k, (port, width, keep, std, white) in enumerate(self._parts):
            out[port] = self._state[k] + white * xi[:, at : at + width]
            fresh = xi[:, at + width : at + 2 * width]
            self._state[k] = keep * self._state[k] + sqrt(1.0 - keep * keep) * std * fresh
            at += 2 * width
        return out


@final
@dataclass(eq=False)
class Sensor:
    """State plus white noise, a quaternion turned by a small random rotation; a ConfigError refuses wrong channels."""

    system: System
    std: tuple[float, ...]
    """Standard deviation of each error channel of the system [its unit; rad for the three of an attitude]."""
    _: KW_ONLY
    scale: float  # factor on all of them, >= 0; with 0 the state is returned as it is
    generator: torch.Generator

    def __post_init__(self) -> None:
        names, std, scale = self.system.error_names, self.std, self.scale
        if len(std) != len(names) or min(std) < 0:
            raise ConfigError(
                f"`sensor_std` takes {len(names)} numbers of 0 or more ({', '.join(names)}); got {std!r}."
            )
        if not scale >= 0:
            raise ConfigError(f"`sensor_noise` must be a factor of 0 or more; got {scale!r}.")
        self._quaternion = self.system.quaternion
        self._std = torch.tensor(std, dtype=torch.float64, device=self.generator.device) * scale
        self._silent = scale == 0 or not any(std)

    def __call__(self, x: Tensor) -> Tensor:
        """The state (B, nx) as measured, (B, nx)."""
        if self._silent:
            return x
        unit = self._std.new_empty(len(x), len(self._std)).normal_(generator=self.generator)
        noise = self._std * unit
        if self._quaternion is None:
            return x + noise
        start = self._quaternion.start
        before, turn, after = noise[:, :start], noise[:, start : start + 3], noise[:, start + 3 :]
        q = turned(x[:, self._quaternion], turn)
        return torch.cat((x[:, :start] + before, q, x[:, self._quaternion.stop :] + after), 1)


@final
class Plant:
    """A batch of simulated machines under sampled control.

    Args:
        system: The machine with all effects that act on it, memory included. It is copied; its parameters are
            taken as they are now.
        dt: Sample: commands are held and states are measured at this interval [s], > 0.
        generator: Source of all randomness; it also sets the device.
        step: Fine step of the integration [s]; `dt` must be a multiple of it. An effect with a time constant
            below about a third of it makes the integration unstable (not checked; see `NonFiniteError`).
        gusts: What pushes each port.
        sensor_std: Noise of each error channel (see `Sensor`); None measures the state itself.
        process_noise: Factor on all gusts.
        sensor_noise: Factor on all sensor noise.
        latency: Time from a command to its effect [s], >= 0, rounded to fine steps.
        limits: Lowest and highest command, of all inputs or of each; commands beyond are clipped. None: no limits.
        check: Raise when a state is not finite; otherwise the caller looks after it.

    A ConfigError refuses a time or factor out of range, or limits of another number of inputs.

    Example:
        >>> plant = make_plant("hexacopter", generator=torch.Generator().manual_seed(0))
        >>> measured = plant.reset(x0, u0)
        >>> for _ in range(100):
        ...     measured = plant.step(controller(measured))
    """

    def __init__(
        self,
        system: System,
        *,
        dt: float,
        generator: torch.Generator,
        step: float = 0.005,
        gusts: Mapping[Port, Gust] | None = None,
        sensor_std: tuple[float, ...] | None = None,
        process_noise: float = 1.0,
        sensor_noise: float = 1.0,
        latency: float = 0.0,
        limits: Limits | None = None,
        check: bool = True,
    ) -> None:
        if not (dt > 0 and step > 0):
            raise ConfigError(f"`dt` and `step` must be positive times in seconds; got {dt!r} and {step!r}.")
        self._substeps = round(dt / step)
        if self._substeps < 1 or abs(self._substeps * step - dt) > 1e-6 * dt:
            raise ConfigError(f"`dt` must be a multiple of the fine `step`; got {dt!r} and {step!r} s.")
        if not latency >= 0:
            raise ConfigError(f"`latency` must be a time of 0 s or more; got {latency!r}.")
        self._like = torch.empty(0, dtype=torch.float64, device=generator.device)
        self.system = frozen(system).to(self._like)
        self.dt, self._fine = float(dt), float(dt) / self._substeps
        self.system.set_step(0.0)  # whatever integrator the system came from
        for effect in self.system.effects:
            if isinstance(effect, Effect) and effect.jumps:
                effect.step = self._fine
        self._delay = round(latency / self._fine)
        ends = () if limits is None else ends_of(limits, system.input_names)
        self._limits = [self._like.new_tensor(end) for end in ends]
        self._check = check
        self._gusts = Gusts(gusts or {}, system.ports, dt=dt, scale=process_noise, generator=generator)
        std = (0.0,) * len(system.error_names) if sensor_std is None else sensor_std
        self._sensor = Sensor(system, std, scale=sensor_noise, generator=generator)
        self._forces: Mapping[Port, Tensor] = {}  # held over a sample
        self._sde = WithoutNoise(self.system, lambda t, z, u: self.system.drift(t, z, u, self._forces))
        self._solver = make_step("rk4")
        self._z = self._like.new_empty(0, system.nz)
        self._commands: list[Tensor] = []
        self._samples = 0
        self._began: Time = 0.0

    @property
    def time(self) -> float:
        """Time since the reset [s]."""
        return self._samples * self.dt

    @property
    def whole_state(self) -> Tensor:
        """The true state with the memory of the effects (B, nz), which `resume` takes."""
        return self._z

    @property
    def state(self) -> Tensor:
        """The true state (B, nx), which no controller sees."""
        return self._z[:, : self.system.nx]

    @torch.no_grad()
    def reset(self, x0: Tensor, u0: Tensor | None = None) -> Tensor:
        """Put the machines into true states (B, nx), at rest under commands (B, nu); the measured states (B, nx).

        Commands, None for zeros, were given until now: they fill the latency and the memory of the effects. A
        ShapeError refuses wrong columns, or unequal numbers of rows.
        """
        x = self._rows("x0", x0, self.system.nx)
        u = x.new_zeros(len(x), self._width) if u0 is None else self._rows("u0", u0, self._width)
        if len(x) != len(u):
            raise ShapeError(f"`x0` and `u0` must have equal numbers of rows; got {len(x)} and {len(u)}.")
        return self.resume(self.system.augment(x, self._clipped(u)), u[:, None])

    @torch.no_grad()
    def resume(self, z: Tensor, before: Tensor, *, t0: float | Tensor = 0.0) -> Tensor:
        """As `reset`, in the middle of a run: true states with the memory of the effects (B, nz); gusts are drawn anew.

        Commands given `before`, the newest last, (B, K, nu), K >= 1, fill the latency; where they are fewer, the first
        of them is used for those before it. `t0` is the time of the machines' clock now, which effects that drift in
        time read [s], one number or (B,).
        """
        z = self._rows("z", z, self.system.nz)
        if before.ndim != 3 or before.shape[1] < 1 or len(before) != len(z):
            raise ShapeError(
                f"`before` must be (batch={len(z)}, K, {self._width}) with K of 1 or more; got {tuple(before.shape)}."
            )
        u = [self._clipped(self._rows("before", row, self._width)) for row in before.unbind(1)]
        needed = 1 + -(-self._delay // self._substeps)
        self._z = self.system.project(z)
        self._commands = [*[u[0]] * (needed - len(u)), *u[-needed:]]
        self._samples, self._began = 0, t0
        self._gusts.reset(len(z))
        return self._sensor(self.state)

    @torch.no_grad()
    def restart(self, rows: Tensor, x0: Tensor) -> Tensor:
        """Put some machines (K,) into states (K, nx), as `reset` does with all; the time runs on."""
        x = self._rows("x0", x0, self.system.nx)
        if len(x) != len(rows):
            raise ShapeError(
                f"`rows` and `x0` must have equal numbers of rows; got {len(rows)} and {len(x)}."
            )
        u = self._clipped(x.new_zeros(len(x), self._width))
        self._z = self._z.index_copy(0, rows, self.system.project(self.system.augment(x, u)))
        self._commands = [c.index_copy(0, rows, u) for c in self._commands]
        self._gusts.restart(rows)
        return self._sensor(x)

    @torch.no_grad()
    def step(self, u: Tensor) -> Tensor:
        """Advance all machines by one sample; the measured states at its end (B, nx).

        Commands, and exogenous channels where effects read any, (B, nu + n_exogenous), are held. A ShapeError refuses
        wrong columns or rows, or no reset before; a NonFiniteError, with `check`, a state that is not finite.
        """
        u = self._rows("u", u, self._width)
        if len(u) != len(self._z):
            raise ShapeError(
                f"`u` must have a row for each of the {len(self._z)} machines of the last reset; got {len(u)}."
            )
        self._commands = [*self._commands[1:], self._clipped(u)]
        self._forces = self._gusts.draw()
        z, start = self._z, self._began + self.time
        for k in range(self._substeps):
            # the command that was given `delay` fine steps before this one
            command = self._commands[-1 + (k - self._delay) // self._substeps]
            z = self._solver.advance(self._sde, start + k * self._fine, z, command, self._fine, None)
            z = self._sde.project(z)
        self._z = z
        self._samples += 1
        if self._check and not bool(torch.isfinite(z).all()):
            rows = torch.nonzero(~torch.isfinite(z).all(1))[:, 0].tolist()
            raise NonFiniteError(
                f"the plant left the finite numbers in step {self._samples} ({self.time:.4g} s), "
                f"rows {rows[:8]}{', ...' if len(rows) > 8 else ''} of {len(z)}. "
                "Gentler inputs or a smaller `step` may help."
            )
        return self._sensor(self.state)

    @property
    def _width(self) -> int:
        return self.system.nu + len(self.system.exogenous)

    def _rows(self, name: str, value: Tensor, width: int) -> Tensor:
        value = torch.as_tensor(value).to(self._like)
        if value.ndim != 2 or value.shape[1] != width:
            raise ShapeError(f"`{name}` must be (batch, {width}); got {tuple(value.shape)}.")
        return value

    def _clipped(self, u: Tensor) -> Tensor:
        if not self._limits:
            return u
        nu = self.system.nu
        command = u[:, :nu].clamp(*self._limits)
        return command if u.shape[1] == nu else torch.cat((command, u[:, nu:]), 1)


@final
@dataclass(eq=False)
class LearnedPlant:
    """A learned model in the place of the machine: paths of its equation, noise and lasting disturbances included.

    A ConfigError refuses a model that is no neural SDE, or limits of other inputs.
    """

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
