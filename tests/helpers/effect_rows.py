"""States and terms of effects that tests work out by hand."""

from collections.abc import Mapping

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from nsde_torch.effects import Effect
from nsde_torch.systems import System, make_system


def term(effect: Effect, x: torch.Tensor, u: torch.Tensor | None = None, *, t: float = 0.0) -> torch.Tensor:
    """What an effect without memory adds at states (N, nx) under inputs (N, ...), zero by default."""
    inputs = torch.zeros(len(x), 6) if u is None else u
    return effect(t, x, inputs, x.new_zeros(len(x), 0)).detach()


def flying(
    velocity: list[float], attitude: Rotation | None = None, *, rates: tuple[float, ...] = (0.0, 0.0, 0.0)
) -> torch.Tensor:
    """A multirotor (1, 13) at this velocity [m/s], attitude (level by default) and body rates [rad/s]."""
    x = torch.zeros(1, 13)
    x[0, 3:6] = torch.tensor(velocity)
    x[0, 6:10] = torch.from_numpy(np.roll((attitude or Rotation.identity()).as_quat(), 1)).float()
    x[0, 10:] = torch.tensor(rates)
    return x


def made(system: str, name: str, values: Mapping[str, float | list[float]] | None = None) -> Effect:
    """An effect as it is on a machine."""
    return make_system(system, declared=[]).make_effect(name, values)


def machine_with(
    system: str, name: str, values: Mapping[str, float | list[float]] | None = None, **of_machine: float
) -> System:
    """A machine with this effect, which has these values, and no other."""
    own = {f"{name}.{key}": value for key, value in (values or {}).items()}
    return make_system(system, declared=[], effects=[name], values={**of_machine, **own})


def random_rows(system: System, n: int, *, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """States (n, nx) and inputs (n, nu) in [0, 1] of a machine, float64."""
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(n, system.nx, generator=g, dtype=torch.float64)
    if system.quaternion is not None:
        x[:, system.quaternion] /= x[:, system.quaternion].norm(dim=1, keepdim=True)
    return x, torch.rand(n, system.nu, generator=g, dtype=torch.float64)
