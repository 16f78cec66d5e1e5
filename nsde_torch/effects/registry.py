"""Effects by name: those of the catalogue, and `package.module:Class` of the user's own.

A law of one coordinate is named with it, `coulomb_friction[q2]`, on a machine that has several, and an effect on one
input of several with that, `actuator_lag[rudder]`.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

from nsde_torch.effects import actuators, by_run, cartpole, forces, friction, multirotor_forces, steady
from nsde_torch.effects.base import Effect, Port
from nsde_torch.effects.by_run import BY_RUN, difference_class, target_of
from nsde_torch.effects.coordinates import STORE, Bound
from nsde_torch.effects.expression import Expression, unplaced_expression
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.effects.law import Law, joined_name, law_at, split_name, unplaced
from nsde_torch.effects.one_input import UNPLACED, Input, OnOneInput, on_input
from nsde_torch.errors import ConfigError
from nsde_torch.lookup import class_by_name, did_you_mean

EFFECTS: dict[str, type[Effect]] = {
    cls.name: cls
    for module in (steady, by_run, friction, forces, actuators, cartpole, multirotor_forces)
    for cls in vars(module).values()
    if isinstance(cls, type) and issubclass(cls, Effect) and cls.__module__ == module.__name__
    # what others derive from has no sentence
    if "sentence" in vars(cls) and cls.name not in BY_RUN
}
"""The catalogue: every effect of these modules that can be reported."""

_OWN: dict[str, type[Effect]] = {}  # effects of the user's own that `register` made known


def register(name: str) -> str:
    """Make an effect known, so that `effects_of` lists it and a diagnosis tries it; returns its own name.

    It is given as `package.module:Class` of the user's own.

    Raises:
        ConfigError: as `effect_class`, or another effect has that name.
    """
    cls = effect_class(name)
    cls = cls.law if issubclass(cls, Law) else cls
    if _known().get(cls.name, cls) is not cls:
        raise ConfigError(
            f"effect {name!r}: another effect is called {cls.name!r}; give it a `name` of its own."
        )
    if EFFECTS.get(cls.name) is not cls:
        _OWN[cls.name] = cls
    return joined_name(cls.name, split_name(name)[1])


def key_of(cls: type[Effect]) -> str:
    """What names an effect in any process: its name in the catalogue, `module:Class`, or the text of a law."""
    if issubclass(cls, Expression):
        return cls.name
    if issubclass(cls, OnOneInput):
        return joined_name(key_of(cls.of_all), cls.at.name)
    if issubclass(cls, Law):
        law = cls.law
        own = law.name if (EFFECTS | BY_RUN).get(law.name) is law else f"{law.__module__}:{law.__qualname__}"
        return joined_name(own, cls.at.name)
    if target_of(cls.name) or (EFFECTS | BY_RUN).get(cls.name) is cls:
        return cls.name
    return f"{cls.__module__}:{cls.__qualname__}"


def _known() -> dict[str, type[Effect]]:
    return {**EFFECTS, **_OWN}


def effect_class(
    name: str, coordinates: Sequence[Bound] | None = None, inputs: Sequence[Input] = ()
) -> type[Effect]:
    """Class of an effect: a key of `EFFECTS`, or `package.module:Class` of the user's own; with its place in `[]`.

    A law that is written as text has its coefficients, and not where it acts: see `System.effect_class`.

    Args:
        name: As `canonical_name` returns it, or `package.module:Class`.
        coordinates: Those of the machine. None: of no machine, and the class of a law says what it is called and what
            it includes, but not where it acts.

    Raises:
        ConfigError: unknown name (lists the choices), no such module or class, not an Effect, or no such coordinate.
    """
    if is_law(name):
        return unplaced_expression(name)
    if target_of(name):
        return difference_class(target_of(name))
    base, coordinate = split_name(name)
    cls = class_by_name(base, _known() | BY_RUN, Effect, kind="effect", home="nsde_torch.effects")
    if not issubclass(cls, Law):
        return (
            cls if not coordinate else _on_one_input(cls, coordinate, None if coordinates is None else inputs)
        )
    if coordinates is None:
        return unplaced(cls, coordinate) if coordinate else cls
    return law_at(cls, _coordinate(cls, coordinate, coordinates))


def _on_one_input(cls: type[Effect], name: str, inputs: Sequence[Input] | None) -> type[Effect]:
    """The effect on the input of this name; of no machine where `inputs` is None."""
    if not cls.each_input:
        raise ConfigError(f"effect {cls.name!r} is no law of one coordinate; leave out [{name}].")
    if inputs is None:
        return on_input(cls, replace(UNPLACED, name=name))
    for at in inputs:
        if at.name == name:
            return on_input(cls, at)
    able = ", ".join(joined_name(cls.name, at.name) for at in inputs)
    what = f"choose among {able}" if able else f"the system has none that {cls.name} may be on alone"
    raise ConfigError(f"effect {joined_name(cls.name, name)!r}: {name!r} is no input of the system; {what}.")


def _coordinate(cls: type[Law], name: str, coordinates: Sequence[Bound]) -> Bound:
    """The coordinate that a law is meant for."""
    law = cls.law.name
    if not coordinates:
        raise ConfigError(f"effect {law!r} is a law of one coordinate, and the system declares none.")
    if not name and len(coordinates) == 1:
        return coordinates[0]
    for at in coordinates:
        if name in (at.declared, at.name) and name:
            return at
    choices = ", ".join(joined_name(law, at.declared) for at in coordinates if cls.suits(at))
    wrong = (
        f"the coordinate {name!r} is none of the system's" if name else "the system has several coordinates"
    )
    raise ConfigError(f"effect {joined_name(law, name)!r}: {wrong}; choose among {choices}.")


def canonical_name(name: str, coordinates: Sequence[Bound], aliases: Mapping[str, str]) -> str:
    """What an effect is called on a machine: older names replaced, and a coordinate that goes without saying left out.

    `aliases` are older names of the machine's effects.
    """
    if is_law(name):
        return unplaced_expression(name).name
    name = aliases.get(name, name)
    base, coordinate = split_name(name)
    only = len(coordinates) == 1 and coordinate == coordinates[0].declared
    return base if only else name


def make_effect(
    name: str,
    *,
    system: str,
    ports: Collection[Port],
    n_inputs: int,
    values: Mapping[str, float | list[float]] | None = None,
    coordinates: Sequence[Bound] = (),
    inputs: Sequence[Input] = (),
) -> Effect:
    """Make an effect by name.

    Args:
        name: Key in `EFFECTS`, or `package.module:Class`; with its coordinate in `[]` where the system has several, or
            with the one input of several that it is on.
        system, ports, n_inputs, coordinates, inputs: Those of the system that it will act on.
        values: Initial values of its parameters.

    Raises:
        ConfigError: unknown name, or an effect that is not for that system; lists the choices.
    """
    base, _ = split_name(name)
    known = _known() | BY_RUN
    if ":" not in name and (base not in known or not _may(known[base], system, ports)):
        what = f"does not act on system {system!r}" if base in known else "is not in the catalogue"
        able = effects_of(system, ports, coordinates, inputs)
        raise ConfigError(
            f"effect {name!r} {what}; choose among: {', '.join(sorted(able)) or 'none'}.{did_you_mean(name, able)}"
        )
    law = known.get(base, Effect)
    if issubclass(law, Law) and STORE not in law.kinds and all(at.kind == STORE for at in coordinates):
        able = effects_of(system, ports)
        raise ConfigError(
            f"effect {name!r} is a law of one coordinate and does not act on system {system!r}, which declares none: "
            'coordinates = (Coordinate("q1", "q1_dot", Port.TORQUE, position="q1"),) in its class does so. Without, '
            f"choose among: {', '.join(sorted(able)) or 'none'}."
        )
    cls = effect_class(name, coordinates, inputs)
    if not _may(cls, system, ports):
        raise ConfigError(
            f"effect {name!r} acts on the port {cls.port.value!r} and does not fit system {system!r}, whose ports "
            f"are {', '.join(sorted(p.value for p in ports))}."
        )
    return cls(values, n_inputs=n_inputs)


def _may(cls: type[Effect], system: str, ports: Collection[Port]) -> bool:
    return issubclass(cls, Law) or cls.fits(system, ports)


def effects_of(
    system: str, ports: Collection[Port], coordinates: Sequence[Bound] = (), inputs: Sequence[Input] = ()
) -> dict[str, type[Effect]]:
    """The effects of the catalogue, and those registered, that a system can have.

    Laws for each of its coordinates; what one input may have alone, for each of `inputs`.
    """
    out: dict[str, type[Effect]] = {}
    for name, cls in _known().items():
        if issubclass(cls, Law):
            on = (law_at(cls, at) for at in coordinates if cls.suits(at))
            out |= {effect.name: effect for effect in on}
        elif cls.fits(system, {*ports, Port.INPUT}):
            out[name] = cls
            if cls.each_input:
                out |= {one.name: one for one in (on_input(cls, at) for at in inputs)}
    return out
