"""A copy of a system whose parameters are plain numbers, for drifts that are evaluated very often.

Their bounds need not be worked out at every drift, and nothing in them asks for a gradient.
"""

import copy
from typing import final

import torch
from torch import Tensor

from nsde_torch.effects import Parametrised
from nsde_torch.systems.base import System


def frozen(system: System, *, dtype: torch.dtype = torch.float64) -> System:
    """A copy with its parameters as they are now, worked out in double precision and then of a `dtype`."""
    system = copy.deepcopy(system).double().requires_grad_(False)
    for module in system.modules():
        if isinstance(module, Parametrised):
            values = {name: value.clone() for name, (value, _) in module.declared_parameters().items()}
            for name, value in values.items():
                module.register_buffer(f"frozen_{name}", value, persistent=False)
            module.__dict__["value"] = _Values(module)
    return system.to(dtype=dtype)


@final
class _Values:
    """Looks up the frozen parameters of a module, wherever they have been moved to."""

    def __init__(self, module: Parametrised) -> None:
        self._buffers = module._buffers

    def __call__(self, name: str) -> Tensor:
        value = self._buffers[f"frozen_{name}"]
        assert value is not None
        return value
