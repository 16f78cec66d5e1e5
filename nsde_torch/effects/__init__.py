"""The catalogue of effects: physical terms that a system can be given by name."""

from collections.abc import Collection, Mapping
from difflib import get_close_matches

from nsde_torch.effects.base import Effect, Parameter, Parametrised, Port
from nsde_torch.effects.generic import ConstantForce, CoulombFriction, LinearSpring, ViscousFriction
from nsde_torch.effects.multirotor import AngularDamping, LinearDrag, MotorLag, QuadraticDrag
from nsde_torch.errors import ConfigError

EFFECTS: dict[str, type[Effect]] = {
    cls.name: cls
    for cls in (
        AngularDamping,
        ConstantForce,
        CoulombFriction,
        LinearDrag,
        LinearSpring,
        MotorLag,
        QuadraticDrag,
        ViscousFriction,
    )
}


def make_effect(
    name: str,
    *,
    system: str,
    ports: Collection[Port],
    n_inputs: int,
    values: Mapping[str, float | list[float]] | None = None,
) -> Effect:
    """Make an effect of the catalogue by name.

    Args:
        name: Key in `EFFECTS`.
        system: Name of the system that it will act on, for the message.
        ports: Ports of that system.
        n_inputs: Number of inputs of that system.
        values: Initial values of its parameters.

    Raises:
        ConfigError: unknown name, or an effect whose port the system lacks; lists the choices.
    """
    known = sorted(k for k, c in EFFECTS.items() if c.port in ports and c.fits(system))
    if name not in known:
        near = get_close_matches(name, known, 1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        what = f"does not act on system {system!r}" if name in EFFECTS else "is not in the catalogue"
        raise ConfigError(f"effect {name!r} {what}; choose among: {', '.join(known) or 'none'}.{hint}")
    cls = EFFECTS[name]
    return MotorLag(values, n_inputs=n_inputs) if cls is MotorLag else cls(values)


__all__ = ["EFFECTS", "Effect", "Parameter", "Parametrised", "Port", "make_effect"]
