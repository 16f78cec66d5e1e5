"""What models learn beside their physics: layers, drift, diffusion, distance from the data, filter of inputs."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from nsde_torch.systems import System

_WIDE = 32


def at_zero(system: System) -> Tensor:
    """A state (1, nx) at zero, a quaternion at that of no rotation."""
    x = torch.zeros(1, system.nx)
    if system.quaternion is not None:
        x[:, system.quaternion.start] = 1.0
    return x


def tanh(x: Tensor) -> Tensor:
    """Hyperbolic tangent; compiled code has a fast exponential and a slow tanh (equal to 1e-7 in float32)."""
    return 2.0 * torch.sigmoid(2.0 * x) - 1.0 if torch.compiler.is_compiling() else torch.tanh(x)


def affine(layer: nn.Linear, x: Tensor, *, frozen: bool = False) -> Tensor:
    """A layer on rows (N, n_in); few outputs come column by column, where BLAS is up to six times faster.

    `frozen` passes gradients to `x` but none to the weights.
    """
    weight, bias = (layer.weight.detach(), layer.bias.detach()) if frozen else (layer.weight, layer.bias)
    if layer.out_features >= _WIDE:
        return nn.functional.linear(x, weight, bias)
    return torch.addmm(bias[:, None], weight, x.T).T


class MLP(nn.Module):
    """Fully connected network with one activation after each hidden layer.

    Initial weights are uniform, 1 / sqrt(fan in), biases zero; a small `last_gain`, the factor on the weights of the
    last layer, makes the network start near zero.
    """

    def __init__(
        self,
        n_in: int,
        hidden: Sequence[int],
        n_out: int,
        *,
        activation: Callable[[Tensor], Tensor],
        generator: torch.Generator,
        last_gain: float = 1.0,
    ) -> None:
        super().__init__()
        widths = [n_in, *hidden, n_out]
        self.activation = activation
        layers = [nn.Linear(a, b) for a, b in pairwise(widths)]
        self.layers: Sequence[nn.Linear] = nn.ModuleList(layers)  # type: ignore[assignment]
        for layer in layers:
            bound = layer.in_features**-0.5
            with torch.no_grad():
                layer.weight.uniform_(-bound, bound, generator=generator)
                layer.bias.zero_()
                if layer is layers[-1]:
                    layer.weight.mul_(last_gain)

    def forward(self, x: Tensor, *, frozen: bool = False) -> Tensor:
        """Outputs (N, n_out) for rows (N, n_in); `frozen` keeps gradients from the weights, not from `x`."""
        for layer in self.layers[:-1]:
            x = self.activation(affine(layer, x, frozen=frozen))
        return affine(self.layers[-1], x, frozen=frozen)

    def weight_norm(self) -> Tensor:
        """Sum of squares of all weights (not of the biases)."""
        return sum((layer.weight.square().sum() for layer in self.layers), torch.zeros(()))


class Standardise(nn.Module):
    """Subtracts a mean and divides by a scale, channel by channel; both are set from the training data."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.mean: Tensor
        self.scale: Tensor
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("scale", torch.ones(width))

    def fit(self, rows: Tensor) -> None:
        """Set mean and standard deviation from rows (N, width); a constant channel keeps scale 1."""
        std = rows.std(0)
        self.scale.copy_(torch.where(std > 1e-9, std, torch.ones_like(std)))
        self.mean.copy_(rows.mean(0))

    def forward(self, x: Tensor) -> Tensor:
        """Standardised rows."""
        return ((x.T - self.mean[:, None]) / self.scale[:, None]).T


# A drift without physics: a network of state, features and input gives the rate of every state.
#
#     dx/dt = scale * MLP(standardised (x, features(x), u))
#
# It is what a neural SDE is without prior knowledge: not even that a position is the integral of a velocity.


class BlackBoxDrift(nn.Module):
    """Rate of the state from a tanh network, of which the features of the system are further inputs."""

    def __init__(self, system: System, hidden: Sequence[int], *, generator: torch.Generator) -> None:
        super().__init__()
        width = system.nx + system.residual_features(at_zero(system)).shape[1] + system.nu
        self._system = (system,)  # in a tuple, so that its parameters are not this module's
        self.standardise = Standardise(width)
        self.network = MLP(width, hidden, system.nx, activation=tanh, generator=generator, last_gain=0.1)
        self.scale: Tensor
        self.register_buffer("scale", torch.ones(system.nx))

    def inputs(self, x: Tensor, u: Tensor) -> Tensor:
        """What the network sees (N, width), of state (N, nx) and input (N, nu)."""
        (system,) = self._system
        return torch.cat((x, system.residual_features(x), u[:, : system.nu]), 1)

    @torch.no_grad()
    def fit(self, x: Tensor, u: Tensor, dt: float) -> None:
        """Set standardisation and output scale from windows of states (B, T + 1, nx) and inputs (B, T, nu)."""
        self.standardise.fit(self.inputs(x[:, :-1].flatten(0, 1), u.flatten(0, 1)))
        rate = (torch.diff(x, dim=1) / dt).flatten(0, 1).std(0)
        self.scale.copy_(torch.where(rate > 1e-9, rate, torch.ones_like(rate)))

    def forward(self, x: Tensor, u: Tensor) -> Tensor:
        """Rate of the state (N, nx)."""
        return self.scale * self.network(self.standardise(self.inputs(x, u)))


# Distance-aware diffusion: sigma_i = sigma_max_i h_i(eta), h_i monotone in eta, channel by channel.
#
#     h_i(eta) = sigmoid(softplus(w_i) eta + b_i)
#
# sigma is a density per root second: a step of dt adds a standard deviation of sigma sqrt(dt).
# `sigma_max` is fixed where the user or the supplement states it, and learned otherwise; `h` starts at a
# quarter on the data and 0.95 far away, so that the spread grows about fourfold where the model is ignorant.

START_SHARE, FAR_SHARE = 0.25, 0.95
_HALVINGS = 60


class Diffusion(nn.Module):
    """h_phi and the largest diffusion sigma_max (nx,) [state unit per root second], > 0, which may be learned.

    Channels of a quaternion are `tied`, they share one sigma: equal noise on all four, projected to the sphere, is the
    same rotation noise at every attitude, and noise along the quaternion alone cannot be seen.
    """

    def __init__(self, sigma_max: Tensor, *, learned: bool, tied: slice | None = None) -> None:
        super().__init__()
        n = len(sigma_max)
        channel = torch.arange(n)
        if tied is not None:
            channel[tied] = tied.start + 1
        self.channel: Tensor
        self.register_buffer("channel", channel, persistent=False)
        offset = math.log(START_SHARE / (1 - START_SHARE))
        slope = math.log(FAR_SHARE / (1 - FAR_SHARE)) - offset
        self.log_sigma_max = nn.Parameter(sigma_max.clamp_min(1e-12).log(), requires_grad=learned)
        self.slope = nn.Parameter(torch.full((n,), slope + math.log(-math.expm1(-slope))))
        self.offset = nn.Parameter(torch.full((n,), offset))

    def share(self, eta: Tensor) -> Tensor:
        """h (N, nx) of eta (N,)."""
        gain = nn.functional.softplus(self.slope)[self.channel]
        return torch.sigmoid(gain[:, None] * eta + self.offset[self.channel, None]).T

    @torch.no_grad()
    def through(self, eta: Tensor, sigma: Tensor, far: Tensor) -> None:
        """Set sigma_max and h so that sigma has a given size on data of distance `eta` (N,) and grows away from them.

        `sigma` is its root mean square over them (nx,), > 0, at least `START_SHARE` of `far`, the least one where eta
        is 1 (nx,), which is at least `FAR_SHARE` / `START_SHARE` times `sigma`.
        """
        sigma = torch.maximum(sigma, START_SHARE * far)
        largest = torch.maximum(sigma / START_SHARE, far / FAR_SHARE).double()
        wanted, eta = (sigma / largest).double(), eta.double()
        top = math.log(FAR_SHARE / (1 - FAR_SHARE))
        low, high = torch.full_like(wanted, -40.0), torch.full_like(wanted, top - 1e-3)
        for _ in range(_HALVINGS):  # the share grows with the offset, as h(1) stays
            offset = 0.5 * (low + high)
            share = torch.sigmoid((top - offset)[:, None] * eta + offset[:, None]).square().mean(1).sqrt()
            low, high = torch.where(share < wanted, offset, low), torch.where(share < wanted, high, offset)
        slope = top - offset
        self.log_sigma_max.copy_(largest.log())
        self.offset.copy_(offset)
        self.slope.copy_(slope + torch.log(-torch.expm1(-slope)))

    def forward(self, eta: Tensor) -> Tensor:
        """sigma (N, nx) of eta (N,)."""
        return self.log_sigma_max.exp()[self.channel] * self.share(eta)


# The distance eta in [0, 1] of a feature vector from the training data (supplement A).
#
#     eta(y) = sigmoid(asinh(E(y))),   E = swish network 32-32 of standardised features
#
# The supplement asks for a range of [0, 1] and leaves the last layer open. A sigmoid alone saturates in
# float32 a few standard deviations out; asinh grows like a logarithm, keeps the order and keeps the logit of
# eta finite, so that "further away" is still distinguished far from the data. The gradient of E is written out:
# the losses need it at every step, and a second backward pass would cost more.


class Distance(nn.Module):
    """Network eta (swish) and network mu (tanh), which bounds its convexity, of their hidden widths."""

    def __init__(
        self, n_features: int, hidden: Sequence[int], mu_hidden: Sequence[int], *, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.standardise = Standardise(n_features)
        self.energy_network = MLP(n_features, hidden, 1, activation=nn.functional.silu, generator=generator)
        with torch.no_grad():
            self.energy_network.layers[-1].bias.fill_(-3.0)
        self.mu_network = MLP(n_features, mu_hidden, 1, activation=torch.tanh, generator=generator)

    def energy(self, standardised: Tensor, *, frozen: bool = False) -> Tensor:
        """E of standardised features (N, nf) -> (N,); `frozen` keeps gradients from the weights."""
        return self.energy_network(standardised, frozen=frozen)[:, 0]

    def energy_and_gradient(self, standardised: Tensor) -> tuple[Tensor, Tensor]:
        """E (N,) and its gradient in the standardised features (N, nf), by the chain rule layer by layer."""
        h = standardised
        slopes = []
        *hidden, last = self.energy_network.layers
        for layer in hidden:
            a = layer(h)
            s = torch.sigmoid(a)
            h = a * s
            slopes.append(s * (1.0 + a * (1.0 - s)))
        value = last(h)[:, 0]
        gradient = last.weight.expand(len(h), -1)
        for layer, slope in zip(reversed(hidden), reversed(slopes), strict=True):
            gradient = (gradient * slope) @ layer.weight
        return value, gradient

    @staticmethod
    def link(energy: Tensor) -> Tensor:
        """eta from E."""
        return torch.sigmoid(torch.asinh(energy))

    @staticmethod
    def link_slope(energy: Tensor) -> Tensor:
        """d eta / d E."""
        eta = Distance.link(energy)
        return eta * (1.0 - eta) * torch.rsqrt(1.0 + energy * energy)

    def mu(self, standardised: Tensor) -> Tensor:
        """Local convexity (N,), positive."""
        return torch.exp(self.mu_network(standardised)[:, 0].clamp(-10.0, 10.0))

    def forward(self, features: Tensor, *, frozen: bool = False) -> Tensor:
        """eta (N,) of raw features (N, nf); `frozen` keeps gradients from the weights, not from the features."""
        return self.link(self.energy(self.standardise(features), frozen=frozen))


# Restores inputs that were smoothed by a centred moving average before they were logged.
#
#     u_applied(t) = u(t) + sum_j w_j u(t + j dt),   j = -reach ... reach,   sum_j w_j = 0
#
# The weights are learned with the rest; their sum is zero, so gains keep their meaning. The filter looks
# `reach * dt` into the future of the log, as does the average that it undoes. It models the recording and not the
# machine: a controller, which knows what it applies, does not use it.


class InputFilter(nn.Module):
    """One filter for all inputs, of `reach` taps on each side, `dt` [s] apart."""

    def __init__(self, reach: int, dt: float) -> None:
        super().__init__()
        self.reach, self.dt = reach, dt
        self.weights = nn.Parameter(torch.zeros(2 * reach + 1))

    def forward(self, u: Tensor, dt: float) -> Tensor:
        """Applied inputs (B, T, nu) from logged ones on a grid of step `dt` [s]; ends are held."""
        horizon = u.shape[1]
        lags = torch.arange(-self.reach, self.reach + 1, device=u.device, dtype=u.dtype) * (self.dt / dt)
        at = (torch.arange(horizon, device=u.device, dtype=u.dtype)[:, None] + lags).clamp(0, horizon - 1)
        low = at.floor()
        share = at - low
        w = self.weights - self.weights.mean()
        rows = torch.arange(horizon, device=u.device)[:, None].expand_as(low)
        low_at = low.long()
        high_at = (low_at + 1).clamp_max(horizon - 1)
        matrix = torch.eye(horizon, device=u.device, dtype=u.dtype)
        matrix = matrix.index_put((rows, low_at), w * (1 - share), accumulate=True)
        matrix = matrix.index_put((rows, high_at), w * share, accumulate=True)
        return torch.einsum("st,btn->bsn", matrix, u)
