"""The steps by name."""

from typing import Any

from nsde_torch.errors import ConfigError
from nsde_torch.lookup import class_by_name
from nsde_torch.sde.options import STEP_HOMES
from nsde_torch.sde.step import Step

STEPS: dict[str, type[Step]] = {
    name: class_by_name(home, {}, Step, kind="solver", home="nsde_torch.sde")
    for name, home in STEP_HOMES.items()
}


def make_step(name: str, **options: Any) -> Step:
    """A new step of that name, a key of `STEPS` or `package.module:Class` of the user's own, with its settings.

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
