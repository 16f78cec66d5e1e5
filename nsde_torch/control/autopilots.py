"""What flies a machine in a closed loop: the predictive controller, and a cascade of proportional loops beside it."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import final

import torch
from torch import Tensor, nn

from nsde_torch.control.cascade import Cascade
from nsde_torch.control.compiled import NoCompiler, compiled_estimator
from nsde_torch.control.controller import Controller, Foresight, Plan, Planner
from nsde_torch.control.options import EstimatorOptions
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.reference import Reference, StateReference
from nsde_torch.effects import Port
from nsde_torch.errors import ConfigError
from nsde_torch.models import Model
from nsde_torch.rotation import rotate_back
from nsde_torch.systems import Multirotor, System

# State at the time from which the next command acts, and what pushes the machine that the model does not
# know.
#
# A measurement is old by the state's latency when it arrives, and a command acts only after the actuator's:
# between the two, the commands that are on their way already decide. The model predicts the state forward
# over them:
#
#     z(t + t_a) = F(... F(z(t - t_s), u_{-L}) ..., u_{-1}),      L = (t_s + t_a) / dt
#
# Pushes d on the force ports (accelerations) follow from how wrong the prediction of the last measurement
# was,
#
#     d' = d + (e_v in body axes, e_omega) / tau,                e = measured - predicted
#
# which removes the lasting part of any error of the model (Pannocchia and Rawlings, AIChE J. 49, 2003). The ports of
# other machines reach their rates through an inertia, B = d(rates) / dd:
#
#     d' = d + B^+ e / tau,                e = error of the rates


def whole_samples(name: str, time: float, dt: float) -> int:
    """A time [s] in samples of `dt` [s]; a period is at least one. ConfigError: it is no multiple."""
    steps = round(time / dt)
    if steps < 0 or abs(steps * dt - time) > 1e-6 or (name == "period" and steps < 1):
        raise ConfigError(
            f"`{name}` must be a multiple of {dt:g} s, the sample of the plant; got {time:g} s."
        )
    return steps


_TINY = 1e-20  # keeps a quotient finite where both sides are 0: nothing is left to learn


@final
class Estimator(nn.Module):
    """One update, `forward`, of plain tensors: `past` steps of the fine grid lie between two, `ahead` are predicted."""

    def __init__(self, predictor: Foresight, options: EstimatorOptions, *, period: float) -> None:
        super().__init__()
        self.predictor, self.options = predictor, options
        self.past = whole_samples("period", period, predictor.dt)
        self.ahead = whole_samples("latency", options.latency, predictor.dt)

    def forward(self, x: Tensor, z: Tensor, d: Tensor, commands: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Take a measurement.

        Args:
            x: Measured states (N, nx).
            z, d: States with memory at the measurement before (N, nz), and pushes (N, nd).
            commands: Inputs by the step, (N, past + ahead, nu): those that acted since the measurement before, then
                those that act until the next command does.

        Returns:
            States with memory at this measurement (N, nz), pushes (N, nd), states when the next command acts (N, nz).
        """
        p = self.predictor
        for k in range(self.past):
            z = p(z, commands[:, k], d)
        d = self.learned(x, z, d)
        z = now = torch.cat((x, z[:, p.nx :]), 1) if p.nz > p.nx else x
        for k in range(self.past, self.past + self.ahead):
            z = p(z, commands[:, k], d)
        return now.clone(), d, z.clone()

    def learned(self, x: Tensor, z: Tensor, d: Tensor) -> Tensor:
        """Pushes (N, nd) by what was measured, x (N, nx), where z (N, nz) was predicted under pushes d (N, nd)."""
        o, parts, start = self.options, [], 0
        if isinstance(self.predictor, Predictor) and not isinstance(self.predictor.system, Multirotor):
            return self._along_ports(self.predictor, x, z, d)
        for port, width in self.predictor.ports.items():
            own = d[:, start : start + width]
            start += width
            if port is Port.BODY_FORCE and o.force_time > 0:
                error = rotate_back(x[:, 6:10], x[:, 3:6] - z[:, 3:6])
                own = (own + error / o.force_time).clamp(-o.force_limit, o.force_limit)
            elif port is Port.BODY_MOMENT and o.moment_time > 0:
                error = x[:, 10:13] - z[:, 10:13]
                own = (own + error / o.moment_time).clamp(-o.moment_limit, o.moment_limit)
            parts.append(own)
        return torch.cat(parts, 1) if parts else d

    def _along_ports(self, p: Predictor, x: Tensor, z: Tensor, d: Tensor) -> Tensor:
        if not p.nd or self.options.force_time <= 0:
            return d
        u, one = x.new_zeros(len(x), p.nu), torch.eye(p.nd, dtype=x.dtype)

        def rates(d: Tensor) -> Tensor:
            found = p.drift(z, u, d)
            return torch.stack([found[:, k] for k in p.rates], 1)

        e = torch.stack([x[:, k] - z[:, k] for k in p.rates], 1)
        free = rates(torch.zeros_like(d))
        slope = torch.stack([rates(row.expand(len(x), -1)) - free for row in one], 2)  # B (N, rates, nd)
        # the least squares of B c = e, columns of one length, by conjugate gradients, which end after nd turns
        length = torch.sqrt((slope * slope).sum(1)) + _TINY
        slope = slope / length[:, None]
        found, left = torch.zeros_like(d), (slope * e[:, :, None]).sum(1)
        along, size = left, (left * left).sum(1, keepdim=True)
        for _ in range(p.nd):
            moved = (slope * along[:, None]).sum(2)
            share = size / ((moved * moved).sum(1, keepdim=True) + _TINY)
            found, left = found + share * along, left - share * (slope * moved[:, :, None]).sum(1)
            before, size = size, (left * left).sum(1, keepdim=True)
            along = left + size / (before + _TINY) * along
        return d + found / (length * self.options.force_time)


@dataclass(frozen=True)
class Decision:
    """What an autopilot did at one sample; costs and times only where there is a plan."""

    u: Tensor  # commands (N, nu)
    status: tuple[str, ...] = ()  # one word or two per row
    cost: Tensor | None = None  # (N,)
    gap: Tensor | None = None  # (N,)
    solve_ms: float = 0.0  # time of the solver
    total_ms: float = 0.0  # time of everything between state and command
    iterations: int = 0  # of the solver


class Autopilot(ABC):
    """Flies a batch of machines along a reference."""

    period: float  # time between commands [s]

    @abstractmethod
    def reset(self, x: Tensor) -> Tensor:
        """Start from measured states (N, nx); returns the commands (N, nu) that are given until the first sample."""

    @abstractmethod
    def command(self, t: float, x: Tensor) -> Decision:
        """Commands at time t [s] from the newest measured states (N, nx)."""


@final
@dataclass(eq=False)
class PredictivePilot(Autopilot):
    """The predictive controller with its estimator. ConfigError: times that do not fit into each other."""

    controller: Planner
    model: Model | System | Foresight
    """What the estimator predicts with, the controller's own model as a rule; or what predicts a sample."""
    reference: StateReference  # what to track
    _: KW_ONLY
    period: float  # time between commands [s]
    sample: float  # step on which commands and states are known [s]
    estimator: EstimatorOptions = field(default_factory=EstimatorOptions)  # latency and pushes
    state_latency: float = 0.0  # part of the latency that lies before the command is given [s]
    say: Callable[[str], None] = lambda line: None  # called with one line when something takes long

    def __post_init__(self) -> None:
        model, sample, c = self.model, self.sample, self.controller
        self._dtype = c.dtype
        predictor: Foresight = (
            Predictor(model, dt=sample, dtype=self._dtype) if isinstance(model, Model | System) else model
        )
        if abs(predictor.dt - sample) > 1e-9:
            raise ConfigError(
                f"the model predicts steps of {predictor.dt:g} s, and samples are {sample:g} s apart."
            )
        self._estimator = Estimator(predictor, self.estimator, period=self.period)
        self._ahead = self.estimator.latency - self.state_latency
        self._plan: Plan | None = None
        self._commands = self._z = self._d = torch.empty(0)
        self._update: Callable[..., Sequence[Tensor]] = self._estimator
        if isinstance(c, Controller) and c.solver.compiled and isinstance(predictor, Predictor):
            folder = c.solver.options.cache
            try:
                self._update = compiled_estimator(self._estimator, predictor, folder=folder, say=self.say)
            except NoCompiler as error:
                self.say(f"the estimator runs without compilation: {error}")

    def reset(self, x: Tensor) -> Tensor:
        c, e = self.controller, self._estimator
        u = c.hover.expand(c.batch, -1).contiguous()
        self._plan = None
        self._commands = u[:, None].repeat(1, e.past + e.ahead, 1)
        self._z = e.predictor.augment(x.to(self._dtype), u).contiguous()
        self._d = u.new_zeros(c.batch, e.predictor.nd)
        return u

    @torch.no_grad()
    def command(self, t: float, x: Tensor) -> Decision:
        c, e = self.controller, self._estimator
        started = time.perf_counter()
        measured = x.to(self._dtype)
        z, d, z0 = self._update(measured, self._z, self._d, self._commands)
        good = torch.isfinite(torch.cat((measured, z0), 1)).all(1, keepdim=True)
        if bool(good.all()):
            self._z, self._d = z, d
        else:  # rows without a usable measurement go on as predicted
            free = self._z
            for k in range(e.past):
                free = e.predictor(free, self._commands[:, k], self._d)
            self._z, self._d = torch.where(good, z, free), torch.where(good, d, self._d)
        nx = e.predictor.nx
        window = self.reference.window(t + self._ahead, dt=c.options.dt, steps=c.options.steps)
        self._plan = plan = c.plan(
            z0[:, :nx],
            window.expand(c.batch, -1, -1),
            self._plan,
            elapsed=self.period,
            last=self._commands[:, -1],
            push=self._d,
            memory=z0[:, nx:] if e.predictor.nz > nx else None,
        )
        u = plan.u[:, 0]
        self._commands = torch.cat((self._commands[:, e.past :], u[:, None].expand(-1, e.past, -1)), 1)
        took = 1e3 * (time.perf_counter() - started)
        return Decision(u, plan.status, plan.cost, plan.gap, plan.solve_ms, took, plan.iterations)


@final
class CascadePilot(Autopilot):
    """The cascade of proportional loops, as an autopilot in position mode of `batch` machines at a time.

    ConfigError: the system is no multirotor.
    """

    def __init__(self, system: System, reference: Reference, *, batch: int, period: float) -> None:
        if not isinstance(system, Multirotor):
            raise ConfigError(f"the cascade flies multirotors; got system {system.name!r}.")
        self.reference, self.period, self._batch = reference, period, batch
        self._cascade = Cascade(system, dt=period)
        path = reference.path
        self._a = torch.from_numpy(path.a.copy())
        self._yaw = torch.from_numpy(path.yaw.copy())
        self._yaw_rate = torch.gradient(self._yaw, spacing=path.dt)[0]

    def reset(self, x: Tensor) -> Tensor:
        self._cascade.reset()
        return self._cascade.hover(self._batch)

    def command(self, t: float, x: Tensor) -> Decision:
        started = time.perf_counter()
        wanted = self.reference.at(torch.tensor(t))
        row = min(max(round(t / self.reference.dt), 0), len(self._yaw) - 1)
        rows = (wanted[:3], wanted[3:6], self._a[row], self._yaw[row], self._yaw_rate[row])
        u = self._cascade(x.double(), *(value.expand(self._batch, *value.shape) for value in rows))
        bad = ~torch.isfinite(u).all(1)
        u = torch.where(bad[:, None], self._cascade.hover(self._batch), u)
        status = tuple("hover" if b else "cascade" for b in bad.tolist())
        return Decision(u=u, status=status, total_ms=1e3 * (time.perf_counter() - started))
