"""The systems by name: those of the package, and `package.module:Class` of the user's own."""

from collections.abc import Sequence
from typing import Any

from nsde_torch.effects.base import Effect
from nsde_torch.errors import ConfigError
from nsde_torch.lookup import class_by_name
from nsde_torch.systems.base import System
from nsde_torch.systems.names import SYSTEM_HOMES
from nsde_torch.systems.values import Values

SYSTEMS: dict[str, type[System]] = {
    name: class_by_name(home, {}, System, kind="system", home="nsde_torch.systems")
    for name, home in SYSTEM_HOMES.items()
}


def system_class(name: str) -> type[System]:
    """Class of a system: a key of `SYSTEMS`, or `module:Class` of the user's own; a ConfigError lists the choices."""
    return class_by_name(name, SYSTEMS, System, kind="system", home="nsde_torch.systems")


def make_system(
    name: str,
    *,
    effects: Sequence[str | Effect] = (),
    declared: Sequence[str] | None = None,
    values: Values | None = None,
    **options: Any,
) -> System:
    """Make a system by name: a key of `SYSTEMS`, or `package.module:Class`.

    `effects` are added to the declared physics, or to those `declared` in its place; `values` are initial ones of
    parameters, `name` or `effect.name`, and `options` further arguments of the class (`thrust_degree` of multirotors).
    A ConfigError where a system, effect, parameter or option is unknown.

    Example:
        >>> make_system("hexacopter", effects=["linear_drag"]).effect_names
        ('linear_drag',)
    """
    cls = system_class(name)
    try:
        return cls(effects, declared=declared, values=values, **options)
    except TypeError as error:
        if "unexpected keyword" not in str(error):
            raise
        raise ConfigError(f"system {name!r} does not take one of the options {sorted(options)}.") from error
