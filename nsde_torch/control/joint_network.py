"""The residual networks of a model side by side as one, with its scaling in the weights.

Networks of one depth on the same features are one network whose first weights stand above each other and whose later
ones are blocks on a diagonal. A step of a plan evaluates them on a handful of rows, where what costs is the number of
operations: half as many, and products written as sums, which become loops instead of calls when they are compiled.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import torch
from torch import Tensor, nn

from nsde_torch.columns import few
from nsde_torch.effects import Port
from nsde_torch.models.neural_sde import NeuralSDE

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
