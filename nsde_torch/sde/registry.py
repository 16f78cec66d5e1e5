"""The steps by name."""

from nsde_torch.errors import ConfigError
from nsde_torch.sde.deterministic import Midpoint, RungeKutta4
from nsde_torch.sde.euler_maruyama import EulerMaruyama
from nsde_torch.sde.heun import Heun
from nsde_torch.sde.milstein import (
    MilsteinIto,
    MilsteinItoFree,
    MilsteinStratonovich,
    MilsteinStratonovichFree,
)
from nsde_torch.sde.step import Step

_CLASSES: tuple[type[Step], ...] = (
    EulerMaruyama,
    Heun,
    MilsteinItoFree,
    MilsteinStratonovichFree,
    MilsteinIto,
    MilsteinStratonovich,
    RungeKutta4,
    Midpoint,
)
STEPS: dict[str, type[Step]] = {cls.name: cls for cls in _CLASSES}


def make_step(name: str) -> Step:
    """The step of that name.

    Args:
        name: A key of `STEPS`.

    Returns:
        A new step.

    Raises:
        ConfigError: No step has that name; the message lists the names.

    Example:
        >>> make_step("milstein").strong_order
        1.0
    """
    if name not in STEPS:
        raise ConfigError(f"`solver.name` must be one of {', '.join(STEPS)}; got {name!r}.")
    return STEPS[name]()
