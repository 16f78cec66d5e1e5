"""Inputs before windows, as much of them as the memory of a system's effects can still hold."""

from math import ceil

from torch import Tensor

from nsde_torch.data import Windows
from nsde_torch.systems import System
from nsde_torch.systems.memory import MEMORY_S


def inputs_before(system: System, windows: Windows, indices: Tensor) -> Tensor | None:
    """Inputs of the last `MEMORY_S` seconds before windows (B, K, nu), for `u_before` of `Model.sample`.

    None where the system carries no memory: nothing would change.

    Args:
        system: The machine.
        windows: Windows of the model's step.
        indices: Window numbers (B,).
    """
    if system.nz == system.nx:
        return None
    return windows.before(indices, max(1, ceil(MEMORY_S / windows.dt_model - 1e-9)))
