"""Paths of a model in windows of data, with as many inputs before them as the memory of effects can still hold."""

from math import ceil
from typing import Any

from torch import Generator, Tensor

from nsde_torch.data import Windows
from nsde_torch.models.model import Model
from nsde_torch.systems import System
from nsde_torch.systems.base import MEMORY_S


def inputs_before(system: System, windows: Windows, indices: Tensor) -> Tensor | None:
    """Inputs of the last `MEMORY_S` seconds before windows (B, K, nu), for `u_before` of `Model.sample`.

    Windows are of the model's step. None where the system carries no memory: nothing would change.
    """
    if system.nz == system.nx:
        return None
    return windows.before(indices, max(1, ceil(MEMORY_S / windows.dt_model - 1e-9)))


def sampled(
    model: Model, windows: Windows, indices: Tensor, *, particles: int, generator: Generator, **further: Any
) -> tuple[Tensor, Tensor, Tensor]:
    """Measured states of windows (B, T + 1, nx), sampled ones (P, B, T + 1, nx), and times of the first [s] (B,).

    Windows are of the model's step; `further` is what `Model.sample` takes beside. Inputs are those of a
    controller unless windows begin at interventions; a model that has learned it reads them.
    """
    x, u, t0 = windows.batch(indices)
    replayed = further.pop("replayed", not windows.interventional)
    if model.capabilities.knows_feedback:
        further["replayed"] = replayed
    further = {"dt": model.spec.dt, "t0": t0.to(x.dtype), **further}
    before = inputs_before(model.system, windows, indices)
    paths = model.sample(x[:, 0], u, particles=particles, generator=generator, u_before=before, **further)
    return x, paths, t0
