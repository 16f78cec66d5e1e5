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
from collections.abc import Sequence
from typing import final

import torch
from torch import Tensor, nn

from nsde_torch.columns import few, split_columns
from nsde_torch.effects import Port
from nsde_torch.errors import ConfigError
from nsde_torch.models import Model
from nsde_torch.models.capabilities import has_physics, is_equation
from nsde_torch.models.neural_sde import NeuralSDE
from nsde_torch.rotation import quaternion_rate, rotate, rotate_back
from nsde_torch.sde import Calculus, Step, Time, make_step, within
from nsde_torch.systems import Multirotor, System
from nsde_torch.systems.frozen import frozen

# The residual networks of a model side by side as one, with its scaling in the weights.
#
# Networks of one depth on the same features are one network whose first weights stand above each other and
# whose later ones are blocks on a diagonal. A step of a plan evaluates them on a handful of rows, where what
# costs is the number of operations: half as many, and products written as sums, which become loops instead of
# calls when they are compiled.

_FEW = 16
"""Rows up to which products are written as sums."""


@final
class JointNetwork(nn.Module):
    """One tanh network in the place of several.

    Args:
        weights: Weights of its layers, (n_out, n_in) each.
        biases: Their biases (n_out,).
        ports: What its outputs push.
        widths: How many outputs each port has.
    """

    def __init__(
        self,
        weights: Sequence[Tensor],
        biases: Sequence[Tensor],
        ports: Sequence[Port],
        widths: Sequence[int],
    ) -> None:
        super().__init__()
        self.ports, self.widths = tuple(ports), tuple(widths)
        self.depth = len(weights)
        for k, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            self.register_buffer(f"weight_{k}", weight)
            self.register_buffer(f"bias_{k}", bias)

    @classmethod
    def of(cls, model: NeuralSDE) -> JointNetwork:
        """The residual networks of a model, from raw features to accelerations."""
        networks = {Port(name): network for name, network in model.residuals.items()}
        layers = [[layer for layer in n.layers if isinstance(layer, nn.Linear)] for n in networks.values()]  # type: ignore[union-attr]
        scale = model.residual_inputs.scale.double()
        mean = model.residual_inputs.mean.double()
        sizes = [model.residual_scale(port) for port in networks]
        weights, biases = [], []
        for k, same in enumerate(zip(*layers, strict=True)):
            w = [layer.weight.detach().double() for layer in same]
            b = torch.cat([layer.bias.detach().double() for layer in same])
            if k == 0:
                joined = torch.cat(w) / scale
                b = b - joined @ mean
            else:
                joined = torch.block_diag(*w)
            if k == len(layers[0]) - 1:
                size = torch.cat(
                    [torch.full((len(x),), s, dtype=torch.float64) for x, s in zip(w, sizes, strict=True)]
                )
                joined, b = size[:, None] * joined, size * b
            weights.append(joined)
            biases.append(b)
        return cls(weights, biases, tuple(networks), [n[-1].out_features for n in layers])

    def forward(self, features: Tensor) -> Tensor:
        """Accelerations (N, sum of widths) from raw features (N, nr)."""
        h = features
        for k in range(self.depth):
            h = _affine(h, getattr(self, f"weight_{k}"), getattr(self, f"bias_{k}"))
            if k < self.depth - 1:
                # tanh, which is slow when compiled
                h = torch.tanh(h) if few() else 2.0 * torch.sigmoid(2.0 * h) - 1.0
        return h


def _affine(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    if few() or len(x) > _FEW:
        return torch.addmm(bias, x, weight.T)
    return (x[:, None, :] * weight).sum(-1) + bias


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


@final
class Turning(Step):
    """See the module.

    Args:
        system: The machine, whose `gravity` does not turn with the body.
    """

    name = "turning"
    calculus = "none"
    strong_order = 2.0
    condition = "a multirotor, sigma = 0; forces in body axes change little within a step"
    summary = "no noise, order 2 in what turns, one drift"
    deterministic = True

    def __init__(self, system: Multirotor) -> None:
        self._system = system

    def advance(self, sde: object, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        gravity, memory = self._system.gravity, z.shape[1] - sum(_PARTS)
        p, v, q, w, m = split_columns(z, *_PARTS, memory)
        _, a, _, turn, change = split_columns(sde.drift(t, z, u), *_PARTS, memory)  # type: ignore[attr-defined]
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
            self._residual = JointNetwork.of(learned).to(dtype)
        self.dt, self.dtype = float(dt), dtype
        self.nx, self.nu, self.nz = self.system.nx, self.system.nu, self.system.nz
        knows_ports = learned is None or learned.black_box is None
        self.ports = {p: s.width for p, s in self.system.residual_ports.items()} if knows_ports else {}
        self.nd = sum(self.ports.values())
        own = self.system
        self._step = Turning(own) if isinstance(own, Multirotor) and knows_ports else _without_noise(step)
        self._equation = _Pushed(self)

    def forward(self, z: Tensor, u: Tensor, d: Tensor) -> Tensor:
        """States after a step (N, nz), from states (N, nz), inputs (N, nu) and pushes (N, nd)."""
        self._equation.push = d
        after = self._step.advance(self._equation, 0.0, z, u, self.dt, None)
        # `turning` leaves quaternions of unit length
        return after if isinstance(self._step, Turning) else self.system.project(after)

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
        """Distance (N,) of states (N, nx) from the training data; zero for a model that does not know it."""
        if not self.knows_distance:
            return x.new_zeros(len(x))
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


@final
class _Pushed:
    """The drift with a push, as a step wants it."""

    calculus: Calculus = "either"

    def __init__(self, predictor: Predictor) -> None:
        self._drift = predictor.drift
        self._project = predictor.system.project
        self._system = predictor.system
        self.push = torch.empty(0)

    def drift(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        return self._drift(z, u, self.push)

    def diffusion(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        return torch.zeros_like(z)

    def project(self, z: Tensor) -> Tensor:
        return self._project(z)

    def set_step(self, dt: float) -> None:
        self._system.set_step(dt)

    def inner(self, z: Tensor, y: Tensor) -> Tensor:
        return self._system.inner(z, y)


@final
class _Euler(Step):
    """z' = z + f dt: what every stochastic step of order one becomes without its noise."""

    name = "euler"
    calculus = "none"
    strong_order = 1.0
    condition = "sigma = 0"
    summary = "no noise, order 1, one drift"
    deterministic = True

    def advance(self, sde: object, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        return z + sde.drift(t, z, u) * dt  # type: ignore[attr-defined]


@final
class _Trapezoid(Step):
    """Heun's step without its noise."""

    name = "trapezoid"
    calculus = "none"
    strong_order = 2.0
    condition = "sigma = 0"
    summary = "no noise, order 2, two drifts"
    deterministic = True

    def advance(self, sde: object, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        f = sde.drift(t, z, u)  # type: ignore[attr-defined]
        y = within(sde, z, z + f * dt)  # type: ignore[arg-type]
        return z + 0.5 * dt * (f + sde.drift(t, y, u))  # type: ignore[attr-defined]


def _without_noise(step: Step) -> Step:
    if step.deterministic:
        return step
    return _Trapezoid() if step.name in ("heun", "milstein_heun") else _Euler()
