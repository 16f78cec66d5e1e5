"""The neural SDE: declared physics plus residual networks, and a diffusion that grows away from the data.

    dx = (f_declared(x, u) + f_residual(y)) c dt + sigma_max * h_phi(eta_psi(y)) * dW        (supplement, eq. 4)

c is the clock scale (physical seconds per logged second), 1 where the log's clock is right. Sensor noise of
standard deviation s on the measured state stands beside the diffusion where the system asks for it: the path
starts at x0 + s e0, and what is predicted is a measurement, x_k + s e_k.

White noise alone cannot be right at 0.1 s and at 2 s at once: gusts and thrust errors last. Where the system
names a port for it, a disturbance d of that port (an Ornstein-Uhlenbeck process, the simplest gust model) is
carried as further states, driven by the same distance-aware diffusion and started in its stationary law:

    dd = -d / tau c dt + sigma_max_d * h_d(eta(y)) * dW,    force of the port = effects + residual + d

What differed between the runs of the training, a trim, a zero or a parameter, differs in a run that was not seen: each
path draws numbers of its own for it, which stay the same from its first step to its last.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from nsde_torch.columns import join_columns, split_columns
from nsde_torch.effects import Port
from nsde_torch.errors import ConfigError, ShapeError
from nsde_torch.models import networks
from nsde_torch.models.feedback_model import FeedbackModel, Filter
from nsde_torch.models.model import Capabilities, Model, ModelSpec, normal
from nsde_torch.sde import Calculus, brownian, make_step, rollout
from nsde_torch.systems import System
from nsde_torch.systems.in_run import in_new_runs
from nsde_torch.systems.values import Values


@dataclass(frozen=True)
class SDESpec(ModelSpec):
    """A neural SDE."""

    kinds = ("nsde", "node", "blackbox_nsde")

    _: KW_ONLY
    step: str  # name of the integrator
    solver: Mapping[str, Any] = field(default_factory=dict)  # further arguments of the integrator
    physics: bool = True
    """Whether the declared physics are part of the drift; else a network of state and input is all of it."""
    drift_hidden: tuple[int, ...] = (64, 64)  # widths of that network
    distance_hidden: tuple[int, ...] = (32, 32)  # widths of the distance's network
    mu_hidden: tuple[int, ...] = (8, 8)  # widths of the network of its convexity
    residual_hidden: tuple[int, ...] = (8, 16)  # widths of the residual networks
    sigma_max: tuple[float, ...] | None = None  # fixed largest diffusion, one per state; None learns it
    filter_reach: int = 0  # type: ignore[misc]
    measurement: bool = False  # whether sensor noise is learned
    disturbance: bool = False  # whether the system's disturbed ports carry a lasting disturbance
    learn_lag: bool = False  # whether a lag or a delay of the inputs may be learned that is not declared
    loss: str = "innovations"  # kind of loss, for the record
    between_runs: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """What differs between runs, by target, with its standard deviations (see `in_new_runs`)."""
    feedback: int = 0  # steps that the learned controller of the training runs remembers; 0: none is learned


class NeuralSDE(Model):
    """Neural SDE of a system, with initial `values` of declared parameters.

    Example:
        >>> spec = SDESpec("hexacopter", dt=0.05, horizon=20, step="milstein")
        >>> model = NeuralSDE(spec, generator=torch.Generator().manual_seed(0))
    """

    calculus: Calculus = "either"  # the supplement's star leaves the product open: the integrator decides

    def __init__(self, spec: SDESpec, *, generator: torch.Generator, values: Values | None = None) -> None:
        super().__init__()
        if spec.effects and not spec.physics:
            raise ConfigError(
                f"a model without physics takes no effects; got {list(spec.effects)}. Leave system.effects out."
            )
        self.spec: SDESpec = spec
        self.step = make_step(spec.step, **spec.solver)
        self.system = spec.make_system(values)
        self.system.set_step(spec.dt)
        s, probe = self.system, networks.at_zero(self.system)
        n_features, n_residual = s.features(probe).shape[1], s.network_features(probe).shape[1]
        self.residual_inputs = networks.Standardise(n_residual)
        self.black_box = (
            None if spec.physics else networks.BlackBoxDrift(s, spec.drift_hidden, generator=generator)
        )
        s.requires_grad_(spec.physics)
        options: dict[str, Any] = {"activation": networks.tanh, "generator": generator, "last_gain": 0.1}
        ports = s.residual_ports if spec.physics else {}
        self.residuals = nn.ModuleDict(
            {
                p.value: networks.MLP(n_residual, spec.residual_hidden, k.width, **options)
                for p, k in ports.items()
            }
        )
        self._residual_scale = {port.value: kind.scale for port, kind in s.residual_ports.items()}
        self.eta = networks.Distance(n_features, spec.distance_hidden, spec.mu_hidden, generator=generator)
        fixed = spec.sigma_max
        if fixed is not None and len(fixed) != s.nx:
            raise ConfigError(f"`sigma_max` must have one value per state ({s.nx}); got {len(fixed)}.")
        disturbed = s.disturbed_ports if spec.disturbance and spec.physics else ()
        self._disturbed: dict[Port, int] = {port: s.ports[port] for port in disturbed}
        self.nd = sum(self._disturbed.values())
        start = [torch.full((s.nx,), 0.1) if fixed is None else torch.tensor(fixed)]
        for port, width in self._disturbed.items():
            start.append(torch.full((width,), 0.8 * s.residual_ports[port].scale))
        self.h = networks.Diffusion(torch.cat(start), learned=fixed is None, tied=s.quaternion)
        self.filter = networks.InputFilter(spec.filter_reach, spec.dt) if spec.filter_reach else None
        self.log_tau = nn.Parameter(torch.zeros(self.nd), requires_grad=self.nd > 0)
        self.log_measurement_std = nn.Parameter(torch.full((s.nx,), -7.0), requires_grad=spec.measurement)
        self.freeze_distance = spec.loss != "paper"  # other data losses do not move eta
        width = s.residual_features(probe).shape[1]
        self.feedback = FeedbackModel(width, s.nu, spec.feedback) if spec.feedback else None
        if spec.between_runs:  # refuses what it has not
            in_new_runs(s, spec.between_runs, torch.zeros(1, self._start_widths[-1]))

    @property
    def tau(self) -> Tensor:
        """Time constants of the disturbances (nd,) [s], at least two steps so that every integrator follows."""
        return 2.0 * self.spec.dt + torch.exp(self.log_tau)

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(
            has_physics=self.spec.physics,
            is_equation=True,
            is_stochastic=not self.step.deterministic,
            learns_sensors=self.spec.measurement,
            knows_feedback=self.feedback is not None,
        )

    # ---- the equation ---------------------------------------------------------------------------------

    def residual(self, x: Tensor) -> dict[Port, Tensor]:
        """Learned contribution on each port, from the state (N, nx)."""
        y = self.residual_inputs(self.system.network_features(x))
        return {Port(k): self._residual_scale[k] * network(y) for k, network in self.residuals.items()}

    def residual_scale(self, port: Port) -> float:
        """Size of a typical residual on a port, by which its network is multiplied [unit of the port]."""
        return self._residual_scale[port.value]

    @property
    def residual_ports(self) -> tuple[Port, ...]:
        """Ports that have a residual network."""
        return tuple(Port(name) for name in self.residuals)

    @property
    def disturbed_ports(self) -> tuple[Port, ...]:
        """Ports that carry a lasting disturbance."""
        return tuple(self._disturbed)

    @property
    def nz(self) -> int:
        """Number of states with the memory of the effects and the disturbances."""
        return self.system.nz + self.nd

    def drift(self, t: float | Tensor, z: Tensor, u: Tensor) -> Tensor:
        """Rate of the state (N, nz) per logged second, at a time [s] under applied inputs (N, nu).

        Of state, memory of the effects and disturbances (N, nz); or of the state alone (N, nx), undisturbed and with
        the memory that is stationary under `u`, and then the rate is that of the state.
        """
        s = self.system
        self._check_width(z)
        if z.shape[1] < self.nz:
            return self.drift(t, self.augment(z, u), u)[:, : s.nx]
        own, d = split_columns(z, s.nz, self.nd)
        if self.black_box is not None:
            return self.clock_scale * self.black_box(own, u)
        forces = self.residual(split_columns(own, s.nx, s.nz - s.nx)[0])
        for port, part in zip(self._disturbed, split_columns(d, *self._disturbed.values()), strict=True):
            forces[port] = forces[port] + part if port in forces else part
        return self.clock_scale * join_columns((s.drift(t, own, u, forces), -d / self.tau))

    def set_step(self, dt: float) -> None:
        """Tell the effects the step of the integrator on the logged clock [s]; see `System.set_step`."""
        self.system.set_step(dt * float(self.clock_scale))

    def inner(self, z: Tensor, y: Tensor) -> Tensor:
        """See `System.inner`; disturbances are those of `y`."""
        s = self.system
        if s.nz == s.nx:
            return y
        (own, _), (later, d) = (split_columns(v, s.nz, self.nd) for v in (z, y))
        return join_columns((s.inner(own, later), d))

    def diffusion(self, t: float | Tensor, z: Tensor, u: Tensor) -> Tensor:
        """Standard deviation density (N, nz), or of states alone (N, nx) [unit per root second]; memory has none."""
        s = self.system
        self._check_width(z)
        if z.shape[1] < self.nz:
            return self._sigma(z)[:, : s.nx]
        x, memory, _ = split_columns(z, s.nx, s.nz - s.nx, self.nd)
        of_state, of_disturbance = split_columns(self._sigma(x), s.nx, self.nd)
        return join_columns((of_state, torch.zeros_like(memory), of_disturbance))

    def _check_width(self, z: Tensor) -> None:
        if z.shape[-1] not in (self.nz, self.system.nx):
            raise ShapeError(
                f"`z` must be a state of {self.system.nx} columns ({', '.join(self.system.state_names)}), or of "
                f"{self.nz} with memory and disturbances; got {tuple(z.shape)}."
            )

    def _sigma(self, x: Tensor) -> Tensor:
        return self.h(self.eta(self.system.features(x), frozen=self.freeze_distance))

    def distance(self, x: Tensor) -> Tensor:
        """Distance eta in [0, 1] of states (..., nx) from the training data, (...)."""
        self.system.check_rows("x", x, self.system.nx)
        return self.eta(self.system.features(x.reshape(-1, self.system.nx))).reshape(x.shape[:-1])

    @property
    def measurement_std(self) -> Tensor:
        """Learned standard deviation of the sensors (nx,); zero where the model has none."""
        std = self.log_measurement_std.exp()
        return std if self.spec.measurement else torch.zeros_like(std)

    # ---- sampling -------------------------------------------------------------------------------------

    @property
    def n_start(self) -> int:
        """Width of the normal numbers of a path: of sensors, disturbances, and what differs between runs."""
        return sum(self._start_widths)

    @property
    def _start_widths(self) -> tuple[int, int, int]:
        of_runs = sum(len(std) for std in self.spec.between_runs.values())
        return self.system.nx if self.spec.measurement else 0, self.nd, of_runs

    @contextmanager
    def of_system(self, system: System) -> Iterator[None]:
        """Let another system be the machine for what follows."""
        own, self.system = self.system, system
        try:
            yield
        finally:
            self.system = own

    def paths(
        self,
        x0: Tensor,
        u: Tensor,
        *,
        dt: float,
        noise: Tensor | None,
        start: Tensor | None = None,
        std: Tensor | None = None,
        compile: bool = False,
        t0: float | Tensor = 0.0,
        check: bool = True,
        u_before: Tensor | None = None,
        correct: Callable[[int, Tensor], Tensor] | None = None,
    ) -> Tensor:
        """Paths of the state (P, B, T + 1, nx) under given noise: what training and `sample` share.

        From first states (B, nx) under applied inputs (B, T, nu), in steps of `dt` [s].

        Args:
            noise: Brownian increments (P, B, T, nz), or None for sigma = 0 (integrated by rk4).
            start: Normal numbers that start the paths (P, B, n_start), or None to start at x0 undisturbed, in the mean
                of all runs.
            std: Standard deviation of the sensors (nx,), with `start`.
            check: Raise on a non-finite state.
            u_before: Applied inputs of the steps before (B, K, nu), which the memory of the effects begins with, or
                None for memory that is stationary under u[:, 0].
            correct: A filter of the paths, as `rollout` takes it.
        """
        nx = self.system.nx
        step = make_step("rk4") if noise is None and not self.step.deterministic else self.step
        if step.deterministic:
            noise = None
        given: dict[str, Any] = {"dt": dt, "step": step, "check": check, "correct": correct}
        memory = None
        if u_before is not None and self.system.nz > nx:
            own = self.system.remembered(x0, u[:, 0], u_before, dt=dt * float(self.clock_scale))
            memory = split_columns(own, nx, self.system.nz - nx)[1]
        if start is None:
            z0 = self.augment(x0, u[:, 0], memory=memory)
            path = rollout(self, z0, u, noise=noise, t0=t0, compile=compile, **given)
            return path[..., :nx]
        p, b = start.shape[:2]
        x, flat_u = x0.repeat(p, 1), u.expand(p, *u.shape).reshape(p * b, *u.shape[1:])
        of_sensors, of_disturbances, of_runs = split_columns(start.flatten(0, 1), *self._start_widths)
        if self.spec.measurement:
            assert std is not None
            x = x + of_sensors * std
        memory = None if memory is None else memory.repeat(p, 1)
        given |= {
            "noise": None if noise is None else noise.reshape(1, p * b, *noise.shape[2:]),
            "t0": t0.repeat(p) if isinstance(t0, Tensor) and t0.ndim else t0,
        }
        z0 = self.augment(self.project(x), flat_u[:, 0], of_disturbances, memory)
        if self.spec.between_runs:
            # the column with the number of the run, which nobody reads
            wide = join_columns((flat_u, torch.zeros_like(flat_u[..., :1])))
            # each row is in a run of its own
            with self.of_system(in_new_runs(self.system, self.spec.between_runs, of_runs)):
                path = rollout(self, z0, wide, **given)
        else:
            path = rollout(self, z0, flat_u, compile=compile, **given)
        return path.reshape(p, b, *path.shape[2:])[..., :nx]

    def augment(
        self, x: Tensor, u: Tensor, draw: Tensor | None = None, memory: Tensor | None = None
    ) -> Tensor:
        """State (N, nx) with memory of the effects and disturbances: (N, nz).

        `memory` is stationary under the inputs `u` (N, nu) if it is not given; `draw`, standard normal numbers (N, nd),
        takes the disturbances from their stationary law; None: they are 0.
        """
        z = self.system.augment(x, u) if memory is None else join_columns((x, memory))
        if not self.nd:
            return z
        if draw is None:
            return join_columns((z, z.new_zeros(len(z), self.nd)))
        return join_columns((z, self.disturbance_std(x) * draw))

    def disturbance_std(self, x: Tensor) -> Tensor:
        """Standard deviation of the disturbances in their stationary law (N, nd), at states (N, nx)."""
        sigma = split_columns(self._sigma(x), self.system.nx, self.nd)[1]
        return sigma * torch.sqrt(0.5 * self.tau / self.clock_scale)

    def sample(
        self,
        x0: Tensor,
        u: Tensor,
        *,
        dt: float,
        particles: int,
        generator: torch.Generator,
        measurement: bool = True,
        measurement_std: Tensor | None = None,
        applied: bool = False,
        compile: bool = False,
        t0: float | Tensor = 0.0,
        u_before: Tensor | None = None,
        numbers: Tensor | None = None,
        replayed: bool = False,
    ) -> Tensor:
        """See `Model.sample`.

        Args:
            replayed: True if `u` are inputs of a log that the controller of the training runs made, so that they tell
                what disturbed the machine (see `feedback_model`). False: inputs that were set, whatever happened.
            numbers: What differs in the run of each row (B, n), in the standard deviations of `spec.between_runs`; None
                draws it, as of a run that was not seen.
        """
        x0, u = self.checked(x0, u, particles, generator)
        u_before = self.checked_before(u_before, x0)
        if measurement_std is not None and (
            measurement_std.shape != (self.system.nx,) or not bool((measurement_std >= 0).all())
        ):
            raise ShapeError(f"`measurement_std` must be ({self.system.nx},) and not negative.")
        if not applied:
            u, u_before = self.applied_pair(u, dt, u_before)
        shape = (particles, x0.shape[0], u.shape[1])
        made = {"generator": generator, "device": x0.device, "dtype": x0.dtype}
        noise = brownian(*shape, self.nz, dt=dt, **made)  # type: ignore[arg-type]
        if measurement_std is not None and not self.spec.measurement:
            raise ConfigError(
                "`measurement_std` was given, but this model was trained without sensor noise: its diffusion holds "
                "all of it. Train with model.measurement=true, or leave the argument out."
            )
        std = self.measurement_std if measurement_std is None else measurement_std.to(x0)
        std = std if measurement else torch.zeros_like(std)
        start = normal((*shape[:2], self.n_start), generator, x0) if self.n_start else None
        if numbers is not None and start is not None:
            start[..., start.shape[-1] - numbers.shape[-1] :] = numbers
        given: dict[str, Any] = {"noise": noise, "start": start, "std": std, "compile": compile, "t0": t0}
        if replayed and self.feedback is not None:
            given["correct"] = Filter(self.feedback, self, u, dt, std, generator).moved
        path = self.paths(x0, u, dt=dt, u_before=u_before, **given)
        path = path.expand(particles, *path.shape[1:])
        if not bool((std > 0).any()):
            return path
        later = path[:, :, 1:] + normal((*shape, self.system.nx), generator, x0) * std
        later = self.project(later.flatten(0, 2)).view(later.shape)
        return torch.cat((x0.expand(particles, *x0.shape)[:, :, None], later), 2)
