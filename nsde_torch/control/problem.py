"""The problem that a plan solves (supplement, equations 5 to 7), every term a square:

    J(u) = E sum_{k=1..K} |r(x_k, x_k^ref)|^2 + sum_k |u_{k-1} - u_0|_R^2 + |u_{k-1} - u_{k-2}|_D^2,   low <= u <= high

r stacks the roots of the cost terms at a state:

    sqrt(Q) (p - p_ref, v - v_ref, vec(q q_ref^-1), omega - omega_ref)       tracking, Q of the supplement
    sqrt(c) max(0, |v| - v_max), (tilt), (each wall of the fence)            soft limits
    sqrt(c) eta(x)                                                           where the model is ignorant

The supplement's expectation is the mean over paths; u_0 is 0 there and D is 0. Of q and -q the nearer is meant: the
vector part is that of the short way round. The first line is a multirotor's; that of another machine is sqrt(Q) times
the error of its state in its error channels, angles the short way round.
"""

from math import cos, inf, radians
from typing import Any, final

import numpy as np
import torch
from torch import Tensor, nn

from nsde_torch.columns import columns, few, join_columns, split_columns, stack_columns
from nsde_torch.control.options import ProblemOptions
from nsde_torch.control.predictor import Predictor
from nsde_torch.errors import ConfigError
from nsde_torch.systems import Multirotor, System
from nsde_torch.systems.machine import ends_of
from nsde_torch.systems.machines import MACHINES

_PARTS = (3, 3, 4, 3)


def problem_of(system: System, **given: Any) -> ProblemOptions:
    """What a plan pays for, with what is not given as the machine has it.

    A multirotor has the supplement's weights. Others have 0.1 for errors of velocities that belong to positions and
    10 for all others, in their units, and pay 0.1 for an input at its end: what the swing-ups and the arm of
    docs/content/results/tracking.md were measured with. Inputs end where `Machine.limits` says; where they do not all
    end alike, weights and centres are those of each. ConfigError: nobody says where the inputs end, another number of
    them is meant, or an option is out of range.
    """
    if isinstance(system, Multirotor):
        return ProblemOptions(**given)
    own = MACHINES.get(system.name) or system.machine
    ends = (None, None) if own is None or own.limits is None else ends_of(own.limits, system.input_names)
    low, high = (given.pop(name, end) for name, end in zip(("low", "high"), ends, strict=True))
    if low is None or high is None:
        raise ConfigError(
            f"system {system.name!r} does not say where its inputs end: give mpc.low and mpc.high, or `limits` of its "
            "`machine`."
        )
    box = ProblemOptions(low=low, high=high)
    for name in ("low", "high"):
        box.of_inputs(name, system.input_names)
    low, high = np.array(box.low), np.array(box.high)
    velocities = {v for _, v, _ in system.position_derivatives}
    weights = tuple(0.1 if name in velocities else 10.0 for name in system.error_names)
    weight, centre = 0.1 / (0.5 * (high - low)) ** 2, 0.5 * (low + high)
    plain = {"state_weights": weights, "input_weight": weight.tolist(), "input_centre": centre.tolist()}
    return ProblemOptions(**{**plain, "low": box.low, "high": box.high, **given})


@final
class Residual(nn.Module):
    """Roots of the cost of a state.

    ConfigError: weights of another length than the machine's error channels, or limits that it does not have.
    """

    def __init__(self, predictor: Predictor, options: ProblemOptions) -> None:
        super().__init__()
        system = predictor.system
        n = len(system.error_names)
        if len(options.state_weights) != n:
            raise ConfigError(
                f"`state_weights` takes {n} numbers ({', '.join(system.error_names)}); got "
                f"{len(options.state_weights)}."
            )
        self._flies, self._positions = isinstance(system, Multirotor), predictor.positions
        if not self._flies and min(options.speed_limit, options.tilt_limit) < inf:
            raise ConfigError("`speed_limit` and `tilt_limit` are for multirotors; `fence` limits positions.")
        if options.fence is not None and len(options.fence) != len(self._positions):
            names = ", ".join(system.state_names[k] for k in self._positions)
            raise ConfigError(f"`fence` takes a pair for each of {names}; got {len(options.fence)}.")
        if options.uncertainty_weight > 0 and not predictor.knows_distance:
            raise ConfigError(
                "`uncertainty_weight` needs a model that knows its distance from the data (model=nsde); this one does "
                "not. Leave it at 0."
            )
        self._predictor, self._options = predictor, options
        self.root: Tensor
        self.register_buffer("root", torch.tensor(options.state_weights, dtype=predictor.dtype).sqrt())

    def forward(self, x: Tensor, ref: Tensor) -> Tensor:
        """Roots (N, nr) at states (N, nx) and references (N, nx)."""
        o = self._options
        c = o.limit_weight**0.5
        out = self._flight(x, ref, c) if self._flies else [self.root * self._predictor.system.error(x, ref)]
        if o.fence is not None:
            walls = torch.tensor(o.fence, dtype=x.dtype, device=x.device)
            p = torch.stack([x[..., k] for k in self._positions], -1)
            out += [c * torch.relu(walls[:, 0] - p), c * torch.relu(p - walls[:, 1])]
        if o.uncertainty_weight > 0:
            out.append(o.uncertainty_weight**0.5 * self._predictor.eta(x)[..., None])
        return join_columns(out) if len(out) > 1 else out[0]

    def _flight(self, x: Tensor, ref: Tensor, c: float) -> list[Tensor]:
        """Roots of a multirotor's errors, and of its excess of speed and tilt."""
        o = self._options
        (p, v, q, w), (p_ref, v_ref, q_ref, w_ref) = split_columns(x, *_PARTS), split_columns(ref, *_PARTS)
        out = [self.root * join_columns((p - p_ref, v - v_ref, attitude_error(q, q_ref), w - w_ref))]
        if o.speed_limit < inf:
            speed = torch.sqrt((v * v).sum(-1, keepdim=True) + 1e-6)
            out.append(c * torch.relu(speed - o.speed_limit))
        if o.tilt_limit < inf:
            _, a, b, _ = columns(q)
            out.append(
                10.0 * c * torch.relu(cos(radians(o.tilt_limit)) - (1 - 2 * (a * a + b * b)))[..., None]
            )
        return out


def attitude_error(q: Tensor, q_ref: Tensor) -> Tensor:
    """Vector part (..., 3) of q q_ref^-1, of the sign that turns the short way."""
    if few():
        turn = (q[..., :, None] * q_ref[..., None, :]).flatten(-2) @ _TURN.to(q)
        return turn[..., 1:] * torch.where(turn[..., :1] < 0, -1.0, 1.0).to(q)
    real, *part = _turn(q, q_ref)
    return stack_columns(part) * torch.where(real < 0, -1.0, 1.0).to(q)[..., None]


def _turn(q: Tensor, q_ref: Tensor) -> tuple[Tensor, ...]:
    """The four parts (...) of q q_ref^-1."""
    w, x, y, z = columns(q)
    a, b, c, d = columns(q_ref)
    return (
        *(w * a + x * b + y * c + z * d, -w * b + x * a - y * d + z * c),
        *(-w * c + x * d + y * a - z * b, -w * d - x * c + y * b + z * a),
    )


_TURN = torch.stack([torch.stack(_turn(a, b)) for a in torch.eye(4) for b in torch.eye(4)])
"""q q_ref^-1 as a function of q q_ref^T (16, 4)."""


# Paths and costs of plans, many at once, as functions of plain tensors.
#
# Rows are plans: N of them, each with P paths. Time runs through the one loop that cannot be avoided; all
# else is evaluated for every step of every plan together.


@final
class Horizon(nn.Module):
    """Discretised problem over a model; ConfigError: numbers for another number of inputs, or see `Residual`.

    Attributes:
        steps, nx, nu, nz, nd: Steps, states, inputs, states with memory, pushes.
        particles: Paths of a plan.
    """

    low: Tensor  # of each input (nu,), as the three that follow
    high: Tensor
    input_weight: Tensor
    input_centre: Tensor
    rate_weight: Tensor
    noise: Tensor  # increments of the paths (K, P, nx), zero for a single one

    def __init__(self, predictor: Predictor, options: ProblemOptions) -> None:
        super().__init__()
        self.predictor, self.options = predictor, options
        self.residual = Residual(predictor, options)
        self.steps, self.particles = options.steps, options.particles
        self.nx, self.nu, self.nz, self.nd = predictor.nx, predictor.nu, predictor.nz, predictor.nd
        self.register_buffer("noise", _increments(options, self.nx, predictor.dtype))
        for name in ("low", "high", "input_weight", "input_centre"):
            values = options.of_inputs(name, predictor.system.input_names)
            self.register_buffer(name, torch.tensor(values, dtype=predictor.dtype))
        self.register_buffer("rate_weight", torch.tensor(options.rate_weight, dtype=predictor.dtype))

    def advance(self, z: Tensor, u: Tensor, d: Tensor, noise: Tensor | None = None) -> Tensor:
        """States after a step (N, nz); `noise` (N, nx) are Brownian increments."""
        after = self.predictor(z, u, d)
        if noise is None:
            return after
        push = self.predictor.sigma(z[:, : self.nx]) * noise
        push = torch.cat((push, push.new_zeros(len(z), self.nz - self.nx)), 1) if self.nz > self.nx else push
        return self.predictor.system.project(after + push)

    def rollout(self, z0: Tensor, u: Tensor, d: Tensor) -> Tensor:
        """States (N, P, K + 1, nz) of plans, from first ones (N, nz), inputs (N, K, nu) and held pushes (N, nd)."""
        n, p = len(u), self.particles
        z, d = _repeat(z0, p), _repeat(d, p)
        states = [z]
        for k in range(self.steps):
            # the paths of a plan lie together
            noise = self.noise[k].repeat(n, 1) if p > 1 else None
            z = self.advance(z, _repeat(u[:, k], p), d, noise)
            states.append(z)
        return torch.stack(states, 1).view(n, p, self.steps + 1, self.nz)

    def cost(self, z: Tensor, u: Tensor, ref: Tensor, last: Tensor) -> Tensor:
        """Costs J (N,) of plans: states (N, P, K + 1, nz) and inputs (N, K, nu), see `GaussNewton` for the rest."""
        n, p, k = len(u), self.particles, self.steps
        x = z[:, :, 1:, : self.nx].reshape(n * p * k, self.nx)
        wanted = ref[:, None].expand(n, p, k, self.nx).reshape(n * p * k, self.nx)
        r = self.residual(x, wanted)
        return (r * r).reshape(n, -1).sum(1) / p + self.input_cost(u, last)

    def input_cost(self, u: Tensor, last: Tensor) -> Tensor:
        """What plans pay for their inputs (N,)."""
        centred, change = u - self.input_centre, torch.diff(u, dim=1, prepend=last[:, None])
        squares = self.input_weight * centred * centred + self.rate_weight * change * change
        return squares.flatten(1).sum(1)


def _repeat(x: Tensor, p: int) -> Tensor:
    return x if p == 1 else x.repeat_interleave(p, 0)


def _increments(options: ProblemOptions, nx: int, dtype: torch.dtype) -> Tensor:
    """Antithetic pairs: the mean of an even number of paths has no noise of the first order."""
    k, p = options.steps, options.particles
    if p == 1:
        return torch.zeros(k, 1, nx, dtype=dtype)
    generator = torch.Generator().manual_seed(options.seed)
    half = torch.randn(k, (p + 1) // 2, nx, generator=generator, dtype=torch.float64) * options.dt**0.5
    return torch.cat((half, -half), 1)[:, :p].to(dtype)
