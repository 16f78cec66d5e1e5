"""A drift without physics: a network of state, features and input gives the rate of every state.

    dx/dt = scale * MLP(standardised (x, features(x), u))

It is what a neural SDE is without prior knowledge: not even that a position is the integral of a velocity.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from nsde_torch.models.networks import MLP, Standardise, tanh
from nsde_torch.systems import System


class BlackBoxDrift(nn.Module):
    """Rate of the state from a network.

    Args:
        system: The machine; its features are further inputs.
        hidden: Widths of the network (tanh).
        generator: Source of the initial weights.
    """

    def __init__(self, system: System, hidden: Sequence[int], *, generator: torch.Generator) -> None:
        super().__init__()
        probe = torch.zeros(1, system.nx)
        if system.quaternion is not None:
            probe[:, system.quaternion.start] = 1.0
        width = system.nx + system.residual_features(probe).shape[1] + system.nu
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
