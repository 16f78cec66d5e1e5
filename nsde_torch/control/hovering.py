"""Inputs that hold a machine still, and those that fly a path, by the model's own account.

The rates of velocity and body rates that a path asks for are met in the least-squares sense by Newton steps on u with
the pseudo-inverse of their slope: the inputs of a multirotor with more motors than axes are those of least norm.
"""

from __future__ import annotations

import torch
from torch import Tensor

from nsde_torch.control.predictor import Predictor

_STEPS = 6


@torch.no_grad()
def inputs_for(predictor: Predictor, x: Tensor, wanted: Tensor) -> Tensor:
    """Inputs (N, nu), not clipped, that give states (N, 13) their wanted rates.

    Args:
        predictor: What knows the machine.
        x: States.
        wanted: Accelerations in the world and angular accelerations in the body (N, 6) [m/s2, rad/s2].
    """
    x, wanted = x.to(predictor.dtype), wanted.to(predictor.dtype)
    n, nu = len(x), predictor.nu
    push = x.new_zeros(n, predictor.nd)

    def rates(u: Tensor) -> Tensor:
        rate = predictor.drift(predictor.augment(x, u), u, push)
        return torch.cat((rate[:, 3:6], rate[:, 10:13]), 1)

    def along(direction: Tensor, u: Tensor) -> Tensor:
        return torch.func.jvp(rates, (u,), (direction.expand(n, nu),))[1]

    u = x.new_full((n, nu), 0.4)
    for _ in range(_STEPS):
        slopes = torch.stack([along(e, u) for e in torch.eye(nu, dtype=x.dtype)], 2)
        # directions that hardly turn or lift anything are not worth the inputs that they would take
        u = u + (torch.linalg.pinv(slopes, rtol=1e-3) @ (wanted - rates(u))[..., None])[..., 0]
    return u


def hover_input(predictor: Predictor) -> Tensor:
    """Inputs (nu,) that hold the machine level and still."""
    x = torch.zeros(1, predictor.nx, dtype=predictor.dtype)
    x[:, 6] = 1.0
    return inputs_for(predictor, x, torch.zeros(1, 6))[0]
