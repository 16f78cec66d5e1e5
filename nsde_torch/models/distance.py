"""The distance eta in [0, 1] of a feature vector from the training data (supplement A).

    eta(y) = sigmoid(asinh(E(y))),   E = swish network 32-32 of standardised features

The supplement asks for a range of [0, 1] and leaves the last layer open. A sigmoid alone saturates in
float32 a few standard deviations out; asinh grows like a logarithm, keeps the order and keeps the logit of
eta finite, so that "further away" can still be told far from the data.
The gradient of E is written out: the losses need it at every step, and a second backward pass would cost more.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from nsde_torch.models.networks import MLP, Standardise


class Distance(nn.Module):
    """Network eta and network mu, which bounds its convexity.

    Args:
        n_features: Width of the features.
        hidden: Widths of eta's two hidden layers (swish).
        mu_hidden: Widths of mu's hidden layers (tanh).
        generator: Source of the initial weights.
    """

    def __init__(
        self, n_features: int, hidden: Sequence[int], mu_hidden: Sequence[int], *, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.standardise = Standardise(n_features)
        self.energy_network = MLP(n_features, hidden, 1, activation=nn.functional.silu, generator=generator)
        with torch.no_grad():
            self.energy_network.layers[-1].bias.fill_(-3.0)  # type: ignore[operator]
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
        gradient = last.weight.expand(len(h), -1)  # type: ignore[operator]
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
