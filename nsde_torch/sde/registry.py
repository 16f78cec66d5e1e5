"""The steps by name."""

from typing import Any

from nsde_torch.errors import ConfigError
from nsde_torch.lookup import class_by_name
from nsde_torch.sde.deterministic import Midpoint, RungeKutta4
from nsde_torch.sde.euler_maruyama import EulerMaruyama
from nsde_torch.sde.heun import Heun
from nsde_torch.sde.milstein import (
    MilsteinIto,
    MilsteinItoFree,
    MilsteinStratonovich,
    MilsteinStratonovichFree,
)
from nsde_torch.sde.milstein_heun import MilsteinHeun
from nsde_torch.sde.step import Step
from nsde_torch.sde.torchdiffeq_step import TorchDiffEq

_CLASSES: tuple[type[Step], ...] = (
    EulerMaruyama,
    Heun,
    MilsteinItoFree,
    MilsteinStratonovichFree,
    MilsteinIto,
    MilsteinStratonovich,
    MilsteinHeun,
    RungeKutta4,
    Midpoint,
    TorchDiffEq,
)
STEPS: dict[str, type[Step]] = {cls.name: cls for cls in _CLASSES}


def make_step(name: str, **options: Any) -> Step:
    """The step of that name.

    Args:
        name: A key of `STEPS`, or `package.module:Class` of the user's own.
        options: Arguments of the step's class; those of torchdiffeq have tolerances.

    Returns:
        A new step.

    Raises:
        ConfigError: No step has that name (the message lists the names), or no such module or class.

    Example:
        >>> make_step("milstein").strong_order
        1.0
    """
    if name not in STEPS and ":" not in name:
        raise ConfigError(f"`solver.name` must be one of {', '.join(STEPS)}; got {name!r}.")
    made = class_by_name(name, STEPS, Step, kind="solver", home="nsde_torch.sde")
    try:
        return made(**options)
    except TypeError:
        raise ConfigError(f"solver {name!r} does not take {', '.join(f'`{o}`' for o in options)}.") from None
