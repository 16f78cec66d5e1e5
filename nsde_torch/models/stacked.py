"""Several networks of one shape, computed together: layer by layer one batched matrix product.

y_m = W_m silu(... silu(W_m x_m + b_m) ...) + b_m,    m = 1 ... members
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn


class StackedMLP(nn.Module):
    """Fully connected silu networks side by side; none sees another's rows or weights.

    Args:
        members: Number of networks.
        n_in: Inputs of each.
        hidden: Widths of the hidden layers.
        n_out: Outputs of each.
        generator: Source of the initial weights (uniform, 1 / sqrt(fan in), biases zero).
    """

    def __init__(
        self, members: int, n_in: int, hidden: Sequence[int], n_out: int, *, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for a, b in pairwise((n_in, *hidden, n_out)):
            weight = torch.empty(members, a, b).uniform_(-(a**-0.5), a**-0.5, generator=generator)
            self.weights.append(nn.Parameter(weight))
            self.biases.append(nn.Parameter(torch.zeros(members, 1, b)))

    def forward(self, x: Tensor) -> Tensor:
        """Outputs (members, N, n_out) for rows (members, N, n_in)."""
        last = len(self.weights) - 1
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = torch.baddbmm(bias, x, weight)
            if k < last:
                x = nn.functional.silu(x)
        return x
