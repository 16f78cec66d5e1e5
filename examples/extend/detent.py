"""An effect: the teeth of a linear motor hold the carriage at every pitch.

    p_dot' = ... - a sin(2 pi p / b)

It acts on the port `rate`, the rate of the whole state, which every system has.
"""

import torch
from torch import Tensor

from nsde_torch.effects import Effect, Parameter, Port, Size


class Detent(Effect):
    """A force that repeats along the rail; for systems whose first states are a position and its velocity."""

    port = Port.RATE
    formula = "-a sin(2 pi p / b)"
    source = "teeth of a linear motor"
    size = Size(0.0, "m/s2", scale=0.1, help="largest force over mass")
    pitch = Parameter(0.05, "m", low=0.0, help="distance of the teeth")
    # A diagnosis starts its fits without the effect (size 0), at every point of a grid of pitches.
    shapes = {"pitch": (0.025, 0.05, 0.1)}
    sentence = "The carriage is held with up to {size} every {pitch}."
    separate = "move slowly over several teeth"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """Rate of the state (N, nx): nothing but the velocity's is changed."""
        rate = torch.zeros_like(x)
        rate[:, 1:2] = -self.size * torch.sin(2.0 * torch.pi * x[:, :1] / self.pitch)
        return rate
