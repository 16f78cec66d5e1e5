"""Effects of the catalogue as candidates: which a system may have, where their fits start, and from how many starts."""

from collections.abc import Collection, Mapping, Sequence
from math import prod

import numpy as np

from nsde_torch.effects import EFFECTS, Effect, Law, Port, effect_class, register
from nsde_torch.effects.by_run import RUN, ByRun
from nsde_torch.effects.expression import Expression
from nsde_torch.effects.law import joined_name, split_name
from nsde_torch.effects.one_input import OnOneInput, of_several_units
from nsde_torch.errors import ConfigError
from nsde_torch.systems import System
from nsde_torch.systems.coordinates import SPEEDS, no_zero
from nsde_torch.systems.parameters import own_name

# of an input's size: one that never falls below it is an absolute temperature. A motor under 1.5 to 3 V may have a dead
# band (tests/diagnosis/test_own_machines.py)
_AWAY = 0.8
_RARE_SIGN = 0.02  # of the rows: an input that has one sign with less of the other
Start = dict[str, float | list[float]]
SEVERAL_UNITS = "it has one number for inputs of several units; each input has its own"


def candidate_names(system: System, among: Collection[str] | None = None) -> list[str]:
    """Names of the effects that could be missing from a system and read no channels but its own.

    What an effect of the system contains is none of them: beside it, it would be one law in two names.
    They are chosen from `among`; None for all.
    """
    effects = system.able_effects()
    able = (n for n in effects if (among is None or n in among) and not why_not(system, n))
    return sorted(n for n in able if set(effects[n].exogenous) <= set(system.exogenous))


def why_not(system: System, name: str) -> str:
    """Why a diagnosis does not try an effect that acts on what the machine has; empty where it does."""
    if name in system.effect_names:
        return "it is declared already"
    around = [e.name for e in system.effects if isinstance(e, Effect) and name in e.includes]
    if around:
        return f"it is part of {around[0]}, which is declared"
    cls = effect_class(name)
    if system.nu == 1 and any(cls.PARAMETERS[own].per_input for own in cls.amplitudes):
        return "it compares inputs, and the machine has one"
    if of_several_units(cls, system.input_units[: system.nu]) and not issubclass(cls, OnOneInput):
        return SEVERAL_UNITS
    if cls.port is Port.POSITION and (reason := no_zero(system, name)):
        return reason
    return cls.no_candidate(system.name)


def variable_of(effect: object) -> tuple[str, object] | None:
    """The one quantity that an effect is a function of: its kind, and where it is; None where it is no such term."""
    if isinstance(effect, Expression):
        each = [(source.kind, source.column) for source in effect.sources.values()]
        return each[0] if len(each) == 1 else None
    if isinstance(effect, Law) and effect.along in ("position", "speed"):
        return "state", effect.at.position if effect.along == "position" else effect.at.velocity
    if isinstance(effect, Effect) and effect.along:
        return effect.along, (effect.port, split_name(str(effect.name))[1])
    return None


def without_motion(system: System) -> tuple[str, str]:
    """That no friction and no force is among the candidates of a machine that moves, and the line that adds them.

    Nothing of levels and temperatures, which have effects of stores.
    """
    effects, speeds = system.able_effects(), zip(system.state_names, system.state_units, strict=True)
    named = [n for n, unit in speeds if unit in SPEEDS or unit.endswith("/s")]
    if any(cls.port in system.ports for cls in effects.values()) or not system.ports or not named:
        return "", ""
    (port, width), *_ = system.ports.items()
    of = named[:width]
    # a port of one's own is no attribute of `Port`
    where_to = f"Port.{port.name}" if port.name in vars(Port) else f'Port("{port.value}")'
    made = ", ".join(f'Coordinate("{n}", "{n}", {where_to}, row={k})' for k, n in enumerate(of))
    return (
        f"no friction and no force is among the candidates: system {system.name!r} declares no coordinate, and none is "
        "recognised",
        f"where {' and '.join(of)} {'are velocities' if len(of) > 1 else 'is a velocity'}, this line in its class adds "
        f"them: coordinates = ({made},)",
    )


def check_candidates(system: System, names: Sequence[str], also: Sequence[str] = ()) -> list[str]:
    """Refuse candidates that a system cannot have whatever is logged; register those of one's own, and name them.

    Raises:
        ConfigError: one is not in the catalogue, is declared, or is for other machines; or there is no such class.
    """
    own = [register(key) for key in also]
    for name in names:
        if split_name(system.effect_key(name))[0] not in EFFECTS:
            raise ConfigError(
                f"`candidates` names {name!r}, which `nsde effects` does not list; one of your own goes into `also`."
            )
    effects = system.able_effects()
    read = {c for cls in effects.values() for c in cls.exogenous}
    able = candidate_names(system.reading(*sorted(read - set(system.exogenous))))
    for name in on_coordinates(system, names):
        if reason := why_not(system, name):
            raise ConfigError(f"`candidates` names {name!r}, which is none: {reason}; leave it out.")
        if name not in able:
            raise ConfigError(
                f"`candidates` names {name!r}, which {system.name!r} cannot have beyond its declared physics; it could "
                f"have: {', '.join(able)}."
            )
    return own


def on_coordinates(system: System, names: Sequence[str]) -> list[str]:
    """Names as the system has them.

    A law without a coordinate means that law on each of its coordinates, an effect on all inputs each of them, too.
    """
    out: list[str] = []
    for name in map(system.effect_key, names):
        law, at = effect_class(name), system.bound_coordinates()
        placed = bool(split_name(name)[1])
        if issubclass(law, Law) and not placed and len(at) > 1:
            out += [joined_name(name, c.name) for c in at if law.suits(c)]
            continue
        each = system.single_inputs() if law.each_input and not placed else ()
        out += [] if each and why_not(system, name) == SEVERAL_UNITS else [name]
        out += [joined_name(name, one.name) for one in each]
    return list(dict.fromkeys(out))


def of_each_run(names: Sequence[str]) -> list[str]:
    """Candidates with numbers for each run in the place of some: for where runs have numbers."""
    laws = {cls.includes[0]: cls.name for cls in EFFECTS.values() if issubclass(cls, ByRun)}
    return [joined_name(laws[law], at) for law, at in map(split_name, names) if law in laws]


def starts(
    system: System, name: str, scales: Mapping[str, float], frequencies: Sequence[float]
) -> list[Start]:
    """Values that fits of a candidate start from.

    What it contains and is there lends it the shapes that both have, and a start at which it is that effect: from there
    it explains no less.
    """
    cls = effect_class(name)
    at = cls.at.name if issubclass(cls, OnOneInput) else ""
    # a heat exchanger whose water comes at 338 to 361 K had an asymmetric gain of it, surely
    if cls.around_zero and scales[joined_name("least input", at)] > _AWAY * scales[joined_name("input", at)]:
        return []
    # of a reactor whose inputs are positive a loss of heat was such an asymmetry of both, which is a loss of both
    if cls.both_signs and scales[joined_name("rarer sign", at)] < _RARE_SIGN:
        return []
    found = cls.starts(scales, frequencies)
    if issubclass(cls, ByRun):
        found = [{**start, cls.numbers(): [0.0] * (cls.width * int(scales[RUN]))} for start in found]
    for effect in system.effects:
        assert isinstance(effect, Effect)
        if effect.name not in cls.includes:
            continue
        theirs = values_of(effect)
        alike = {own: theirs[key] for own, key in cls.shared(type(effect)).items()}
        lent = {own: value for own, value in alike.items() if own in cls.shapes}
        for start in [{**start, **more} for more in (lent, alike) for start in found]:
            found += [] if start in found else [start]
    return found


def joined(system: System, name: str, start: Start) -> System:
    """The system with a candidate, without what the candidate contains."""
    if contained := set(effect_class(name).includes) & set(system.effect_names):
        system = system.without_effects(*contained)
    return system.with_effects(system.make_effect(name, start))


def simplified(system: System, name: str, simpler: str) -> System:
    """The system with an effect in the place of one that contains it, at the values that they share.

    One with a number for each run shares none with what has one for all.
    """
    own, plain = values_of(effect_of(system, name)), values_of(system.make_effect(simpler, {}))
    shared = effect_class(name).shared(effect_class(simpler)).items()
    values = {theirs: own[key] for key, theirs in shared if np.shape(own[key]) == np.shape(plain[theirs])}
    return joined(system.without_effects(name), simpler, values)


def alone(name: str, labels: Sequence[str]) -> list[tuple[str, ...]]:
    """What to hold at nothing, a choice at a time: all but one of the parameters of which there is one per input."""
    cls = effect_class(name)
    each = [label for label in labels if cls.PARAMETERS[own_name(label)].per_input]
    return [tuple(x for x in each if x != label) for label in each] or [()]


def effect_of(system: System, name: str) -> Effect:
    """The effect of a system that has this name."""
    return next(e for e in system.effects if isinstance(e, Effect) and e.name == name)


def values_of(effect: Effect) -> dict[str, float | list[float]]:
    return {
        key: value.tolist() if value.numel() > 1 else float(value)
        for key, (value, _) in effect.declared_parameters().items()
    }


def frequencies_in(steps: int) -> float:
    """Number of independent frequencies of a stretch of so many steps, at least 1."""
    return max(1.0, 0.5 * steps)


def starts_of(effect: str, labels: Sequence[str], steps: int) -> float:
    """How many starts the best of which was taken: frequencies of the spectrum, or shapes, each for every input.

    `labels` are those of its parameters, `steps` is the length of the longest stretch of the data.
    """
    if "spectrum" in effect_class(effect).relative.values():
        return frequencies_in(steps)
    grid = prod(len(values) for values in effect_class(effect).shapes.values())
    return float(grid * len(alone(effect, labels)))
