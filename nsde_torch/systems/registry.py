"""The systems by name: those of the package, and `package.module:Class` of the user's own."""

from collections.abc import Sequence
from typing import Any

import torch

from nsde_torch.effects.base import Effect
from nsde_torch.errors import ConfigError
from nsde_torch.lookup import class_by_name, raised
from nsde_torch.systems.base import System
from nsde_torch.systems.names import SYSTEM_HOMES
from nsde_torch.systems.values import Values

SYSTEMS: dict[str, type[System]] = {
    name: class_by_name(home, {}, System, kind="system", home="nsde_torch.systems")
    for name, home in SYSTEM_HOMES.items()
}


def system_class(name: str) -> type[System]:
    """Class of a system: a key of `SYSTEMS`, or `module:Class` of the user's own; a ConfigError lists the choices."""
    cls = class_by_name(name, SYSTEMS, System, kind="system", home="nsde_torch.systems")
    needed = (*("name", "state_names", "state_units", "input_names", "input_units"), "ports", "defaults")
    missing = [f"`{own}`" for own in (*needed, "residual_ports") if not hasattr(cls, own)]
    if missing:
        raise ConfigError(f"system {name!r} does not say what its {', '.join(missing)} are.")
    return cls


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
        made = cls(effects, declared=declared, values=values, **options)
    except TypeError as error:
        if "unexpected keyword" not in str(error):
            raise
        raise ConfigError(f"system {name!r} does not take one of the options {sorted(options)}.") from error
    if ":" in name and cls not in _TRIED:
        _check_dynamics(made)
        _TRIED.add(cls)
    return made


_TRIED = set[type[System]]()


@torch.no_grad()
def _check_dynamics(system: System) -> None:
    """That a machine of the user's own has rates of several states at once, and does what its ports say.

    A ConfigError names what it does not.
    """
    rng = torch.Generator().manual_seed(0)
    x, u = (0.5 + torch.rand(3, n, generator=rng) for n in (system.nx, system.nu))
    if system.quaternion is not None:
        x[:, system.quaternion] /= x[:, system.quaternion].norm(dim=1, keepdim=True)
    before: torch.Tensor | None = None
    for port in (None, *system.ports):
        forces = {} if port is None else {port: torch.ones(3, system.ports[port])}
        given = "" if port is None else f" and a force (N, {system.ports[port]}) on {port.value!r}"
        what = f"`dynamics` of system {system.name!r}, of states (N, {system.nx}), inputs (N, {system.nu}){given},"
        try:
            rates = system.dynamics(0.0, x, u, forces)
        except Exception as error:  # of the user's own file, whatever it is
            raise ConfigError(f"{what} fails: {raised(error, 'dynamics')}.") from error
        if not isinstance(rates, torch.Tensor) or rates.shape != x.shape:
            shape = tuple(rates.shape) if isinstance(rates, torch.Tensor) else type(rates).__name__
            raise ConfigError(f"{what} must return rates (N, {system.nx}); of 3 states it returned {shape}.")
        if before is not None and torch.equal(rates, before):
            raise ConfigError(
                f"{what} does not answer it: add `forces[port]` to a rate where `port in forces`, or leave the "
                "port out of `ports`; effects on it would do nothing."
            )
        before = rates if port is None else before
