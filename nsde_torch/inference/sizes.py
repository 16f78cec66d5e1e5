"""Sizes of data, which the shapes of effects are measured by (see `Effect.relative`)."""

import numpy as np
from torch import Tensor

from nsde_torch.effects.law import joined_name
from nsde_torch.inference.steps import Steps
from nsde_torch.systems import System

_COLUMNS = {"position": 0, "speed": 1, "rate": 3}
"""Of effects of the user's own that are no laws of a coordinate."""
_LEAST = 1e-6
SLOW = 0.02  # share of the rows that are slower than a slow speed


def data_sizes(system: System, steps: Steps) -> dict[str, float]:
    """95 % quantiles of absolute values of the inputs and of the states that effects see, and the step [s]."""

    def size(values: Tensor, share: float = 0.95) -> float:
        return max(float(np.quantile(values.abs().numpy(), share)), _LEAST) if values.numel() else 1.0

    out = {"input": size(steps.u[:, : system.nu]), "step": steps.dt}
    out |= {kind: size(steps.x0[:, k]) for kind, k in _COLUMNS.items() if k < system.nx}
    for at in system.bound_coordinates():
        out[joined_name("speed", at.name)] = size(steps.x0[:, at.velocity])
        out[joined_name("slow speed", at.name)] = size(steps.x0[:, at.velocity], SLOW)
        if at.position is not None:
            out[joined_name("position", at.name)] = size(steps.x0[:, at.position])
    return out
