"""What the controller knows of the machine: one step of the model without noise, as plain tensors.

    z_{k+1} = F(z_k, u_k, d) = project(step(z_k, u_k, f + d, h)),        z = (state, memory of the effects)

f is the drift of a model (or of declared physics alone) in physical seconds, h the step of the horizon, and d a push
on the force ports that the controller estimates while it flies (see `estimator`). A model with the physics of a
multirotor is stepped by `turning`, whatever it was trained with: also one that was fitted through Euler steps of 50 ms
flies nearer to its path so (2.4 instead of 8.0 cm on a circle at 3.6 m/s without noise). Others take the step that
they were trained with, its noise left out.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, final

import torch
from torch import Tensor, nn

from nsde_torch.columns import few, split_columns
from nsde_torch.effects import Port
from nsde_torch.errors import ConfigError
from nsde_torch.models import Model
from nsde_torch.models.model import has_physics, is_equation
from nsde_torch.models.neural_sde import NeuralSDE
from nsde_torch.rotation import quaternion_rate, rotate, rotate_back
from nsde_torch.sde import Step, Time, WithoutNoise, make_step, within
from nsde_torch.systems import Multirotor, System
from nsde_torch.systems.parameters import frozen

# The residual networks of a model side by side as one, with its scaling in the weights.
#
# Networks of one depth on the same features are one network whose first weights stand above each other and
# whose later ones are blocks on a diagonal. A step of a plan evaluates them on a handful of rows, where what
# costs is the number of operations: half as many, and products written as sums, which become loops instead of
# calls when they are compiled.

_FEW = 16  # rows up to which products are written as sums


@final
class JointNetwork(nn.Module):
    """One tanh network in the place of the residual networks of a model, from raw features to accelerations.

    `ports` are what its outputs push, `widths` how many outputs each has.
    """

    def __init__(self, model: NeuralSDE) -> None:
        super().__init__()
        self.ports = model.residual_ports
        networks: list[Any] = list(model.residuals.values())
        layers = [[layer for layer in n.layers if isinstance(layer, nn.Linear)] for n in networks]
        self.widths, self.depth = [n[-1].out_features for n in layers], len(layers[0])
        scale = model.residual_inputs.scale.double()
        mean = model.residual_inputs.mean.double()
        for k, same in enumerate(zip(*layers, strict=True)):
            w = [layer.weight.detach().double() for layer in same]
            b = torch.cat([layer.bias.detach().double() for layer in same])
            if k == 0:
                joined = torch.cat(w) / scale
                b = b - joined @ mean
            else:
                joined = torch.block_diag(*w)
            if k == self.depth - 1:
                sizes = [model.residual_scale(port) for port in self.ports]
                size = torch.tensor(sizes, dtype=torch.float64).repeat_interleave(torch.tensor(self.widths))
                joined, b = size[:, None] * joined, size * b
            self.register_buffer(f"weight_{k}", joined)
            self.register_buffer(f"bias_{k}", b)

    def forward(self, features: Tensor) -> Tensor:
        """Accelerations (N, sum of widths) from raw features (N, nr)."""
        h = features
        for k in range(self.depth):
            weight, bias = getattr(self, f"weight_{k}"), getattr(self, f"bias_{k}")
            if few() or len(h) > _FEW:
                h = torch.addmm(bias, h, weight.T)
            else:
                h = (h[:, None, :] * weight).sum(-1) + bias
            if k < self.depth - 1:
                # tanh, which is slow when compiled
                h = torch.tanh(h) if few() else 2.0 * torch.sigmoid(2.0 * h) - 1.0
        return h


# A step of second order for multirotors with one evaluation of the drift: forces turn with the body.
#
# Within a step the specific force f in body axes and the angular acceleration stay, and the attitude turns:
#
#     w' = w + h a_w                     q' = q turned by h (w + h a_w / 2)
#     a' = R(q') f + g,   f = R(q)^T (a - g)
#     v' = v + h (a + a') / 2            p' = p + h v + h^2 (2 a + a') / 6
#
# What is left out is how f and a_w themselves change within a step (drag, learned residuals, and lags, which
# know the step by `System.set_step`). Euler's step leaves h^2 a / 2 of the position out: at 3.6 m/s on a
# circle, 8 mm every 50 ms, which a plan makes up for by flying inside the circle.

_PARTS = (3, 3, 4, 3)  # position, velocity, quaternion, rates
Advance = Callable[[WithoutNoise, Time, Tensor, Tensor, float, None], Tensor]


def _turning(sde: WithoutNoise, t: Time, z: Tensor, u: Tensor, dt: float, dw: None) -> Tensor:
    gravity: Tensor = sde.system.gravity  # type: ignore[assignment]
    memory = z.shape[1] - sum(_PARTS)
    p, v, q, w, m = split_columns(z, *_PARTS, memory)
    _, a, _, turn, change = split_columns(sde.drift(t, z, u), *_PARTS, memory)
    after = q + dt * quaternion_rate(q, w + (0.5 * dt) * turn)
    after = after * torch.rsqrt((after * after).sum(-1, keepdim=True))
    later = rotate(after, rotate_back(q, a - gravity)) + gravity
    parts = (
        p + dt * v + (dt * dt / 6.0) * (2.0 * a + later),
        v + (0.5 * dt) * (a + later),
        after,
        w + dt * turn,
        m + dt * change,
    )
    return torch.cat(parts, 1)


@final
class Predictor(nn.Module):
    """One step of a model's mean path on rows.

    Args:
        model: A learned model, or a system whose declared physics is all that is known. It is copied, its parameters
            as they are now.
        dt: Step of the horizon [s], > 0.
        dtype: Precision.

    Attributes:
        system: The machine, parameters frozen.
        nx, nu, nz: States, inputs, states with memory.
        ports: Force ports that d pushes, with their widths; nd is their sum.
        positions, rates: Columns of the positions, and of what forces move: velocities and rates.

    Raises:
        ConfigError: a model of a kind that has no drift, or effects that read further logged channels.
    """

    def __init__(self, model: Model | System, *, dt: float, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        if not dt > 0:
            raise ConfigError(f"`dt` must be a step above 0 s; got {dt!r}.")
        learned = None
        step = make_step("rk4")
        if isinstance(model, System):
            system = model
        elif is_equation(model):
            learned = copy.deepcopy(model).eval().requires_grad_(False)
            system, step = learned.system, learned.step
        elif has_physics(model):
            system, step = model.system, model.step
        else:
            raise ConfigError(
                f"a model of kind {model.spec.kind!r} has no drift to plan with; take one of nsde, node, blackbox_nsde "
                "or sysid, or the declared physics."
            )
        if system.exogenous:
            raise ConfigError(
                f"effects of the model read {', '.join(system.exogenous)}, which a plan cannot foresee. Leave them out."
            )
        self.system = frozen(system, dtype=dtype)
        self.system.set_step(dt)
        if learned is not None:
            learned.system = self.system
            learned.to(dtype=dtype)
        self._learned = learned
        self._residual = None
        if learned is not None and learned.black_box is None and len(learned.residuals):
            self._residual = JointNetwork(learned).to(dtype)
        self.dt, self.dtype = float(dt), dtype
        self.nx, self.nu, self.nz = self.system.nx, self.system.nu, self.system.nz
        names, of = list(self.system.state_names), self.system.quaternion or slice(0, 0)
        self.positions = [names.index(q) for q, _, _ in self.system.position_derivatives]
        kinematic = {*self.positions, *range(of.start, of.stop)}
        self.rates = [k for k in range(self.nx) if k not in kinematic]
        knows_ports = learned is None or learned.black_box is None
        self.ports = {p: s.width for p, s in self.system.residual_ports.items()} if knows_ports else {}
        self.nd = sum(self.ports.values())
        self._turns = isinstance(self.system, Multirotor) and knows_ports
        self._advance = _turning if self._turns else _without_noise(step)

    def forward(self, z: Tensor, u: Tensor, d: Tensor) -> Tensor:
        """States after a step (N, nz), from states (N, nz), inputs (N, nu) and pushes (N, nd)."""
        # a push that stayed here would be part of the key under which machine code is kept
        pushed = WithoutNoise(self.system, lambda t, z, u: self.drift(z, u, d))
        after = self._advance(pushed, 0.0, z, u, self.dt, None)
        return after if self._turns else self.system.project(after)

    def drift(self, z: Tensor, u: Tensor, d: Tensor) -> Tensor:
        """Rates (N, nz) per physical second."""
        learned, s = self._learned, self.system
        if learned is not None and learned.black_box is not None:
            return learned.black_box(z, u)
        forces: dict[Port, Tensor] = {}
        if self._residual is not None:
            out = self._residual(s.network_features(split_columns(z, s.nx, s.nz - s.nx)[0]))
            forces = dict(zip(self._residual.ports, split_columns(out, *self._residual.widths), strict=True))
        if self.nd:
            for port, part in zip(self.ports, split_columns(d, *self.ports.values()), strict=True):
                forces[port] = forces[port] + part if port in forces else part
        return s.drift(0.0, z, u, forces)

    def eta(self, x: Tensor) -> Tensor:
        """Distance (N,) of states (N, nx) from the training data, of a model that knows it."""
        assert self._learned is not None
        return self._learned.eta(self.system.features(x))

    @property
    def knows_distance(self) -> bool:
        """Whether the model has learned where it is ignorant."""
        return self._learned is not None and self._learned.capabilities.is_stochastic

    def sigma(self, x: Tensor) -> Tensor:
        """Diffusion of the state (N, nx) [state unit per root second]; zero for a model without."""
        if not self.knows_distance:
            return torch.zeros_like(x)
        assert self._learned is not None
        return self._learned.h(self.eta(x))[:, : self.nx]

    def augment(self, x: Tensor, u: Tensor) -> Tensor:
        """States (N, nx) with the memory that is stationary under inputs (N, nu): (N, nz)."""
        return self.system.augment(x, u)


def _euler(sde: WithoutNoise, t: Time, z: Tensor, u: Tensor, dt: float, dw: None) -> Tensor:
    return z + sde.drift(t, z, u) * dt


def _trapezoid(sde: WithoutNoise, t: Time, z: Tensor, u: Tensor, dt: float, dw: None) -> Tensor:
    f = sde.drift(t, z, u)
    return z + 0.5 * dt * (f + sde.drift(t, within(sde, z, z + f * dt), u))


def _without_noise(step: Step) -> Advance:
    """What a step becomes without its noise; every stochastic one of order one is then Euler's."""
    if step.deterministic:
        return step.advance
    return _trapezoid if step.name in ("heun", "milstein_heun") else _euler
