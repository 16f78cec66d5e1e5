"""The coordinates of a system by columns; effects made for them, and the check that each acts where there is room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from nsde_torch.effects import units
from nsde_torch.effects.base import Effect, Port
from nsde_torch.effects.by_run import target_of
from nsde_torch.effects.coordinates import KINDS, PLACE, STORE, Bound, Coordinate
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.effects.law import Law
from nsde_torch.effects.registry import effect_class, make_effect
from nsde_torch.errors import ConfigError
from nsde_torch.systems.in_run import difference_on
from nsde_torch.systems.values import ErrorGroup, Numbers, Values
from nsde_torch.systems.vocabulary import offered

if TYPE_CHECKING:
    from nsde_torch.systems.base import System

_ANGLES = ("rad", "deg")
_FRAMES = ("world", "body")  # in which a velocity is that of its position
SPEEDS = ("m/s", "rad/s", "deg/s")  # units by which a state is known for a velocity


@cache
def bound_coordinates(cls: type[System]) -> tuple[Bound, ...]:
    """See `System.bound_coordinates`."""
    declared, states = cls.coordinates or _only(cls), list(cls.state_names)
    if not declared:
        return _stores(cls)
    names = [c.name for c in declared]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ConfigError(f"system {cls.name!r} has two coordinates called {twice[0]!r}; names are unique.")
    port_units = {port: residual.unit for port, residual in cls.residual_ports.items()}
    out: list[Bound] = []
    for c in declared:
        _check(c, cls)
        velocity = states.index(c.velocity)
        position = states.index(c.position) if c.position else None
        speed = cls.state_units[velocity]
        force = c.unit or port_units.get(c.port) or units.of("speed/s", {"speed": speed})
        where = cls.state_units[position] if position is not None else units.of("speed s", {"speed": speed})
        only = len(declared) == 1
        name, words = "" if only else c.name, c.words or ("the motion" if only else c.name)
        of = (("position", where), ("speed", speed), ("force", force))
        place = (position, velocity, c.port, c.row, cls.ports[c.port])
        kind = c.kind or ("joint" if where in _ANGLES else "rail")
        out.append(Bound(name, *place, kind, of, words, c.load, c.name))
    return (*(replace(at, chain=_chain(out, at)) for at in out), *_places(cls, out))


def _chain(declared: Sequence[Bound], at: Bound) -> tuple[tuple[int, int], ...]:
    angles = [
        b for b in declared if b.port == at.port and b.kind != "rail" and dict(b.units)["position"] == "rad"
    ]
    if at not in angles or len(angles) < 2 or any(b.position is None for b in angles):
        return ()
    return tuple((b.row, b.position) for b in angles[: angles.index(at) + 1] if b.position is not None)


def _check(c: Coordinate, cls: type[System]) -> None:
    where = f"coordinate {c.name!r} of system {cls.name!r}"
    if not c.name.isidentifier():
        raise ConfigError(f"{where}: its name must be a word, as effects are called by it: friction[q2].")
    for what, state in (("velocity", c.velocity), ("position", c.position)):
        if state not in cls.state_names and not (what == "position" and not state):
            states = ", ".join(cls.state_names)
            raise ConfigError(f"{where}: its {what} is {state!r}, which is no state; states are {states}.")
    if c.position == c.velocity:
        raise ConfigError(f"{where}: position and velocity are the same state {c.velocity!r}.")
    if c.port not in cls.ports:
        ports = ", ".join(p.value for p in cls.ports)
        raise ConfigError(f"{where}: port {c.port.value!r} is none of the system's: {ports}.")
    if not 0 <= c.row < cls.ports[c.port]:
        width = cls.ports[c.port]
        raise ConfigError(
            f"{where}: row {c.row} is not on the port {c.port.value!r}, which has {width} (from 0)."
        )
    if c.kind and c.kind not in KINDS:
        raise ConfigError(f"{where}: kind {c.kind!r} is none of {', '.join(KINDS)}.")
    if c.load and cls.quantities.get(c.load) != 1:
        raise ConfigError(f"{where}: load {c.load!r} must be one of `quantities`, one column wide.")


def _check_names(cls: type[System]) -> None:
    """That names and units of a class go together, before they are looked for in a log."""
    name, inputs = getattr(cls, "name", cls.__name__), getattr(cls, "input_names", ())
    for what, names, of in (
        ("state", cls.state_names, cls.state_units),
        ("input", inputs, getattr(cls, "input_units", inputs)),
    ):
        if isinstance(names, str) or isinstance(of, str):
            raise ConfigError(
                f"system {name!r}: `{what}_names` and `{what}_units` are tuples, ('q',) where there is one; "
                f"got {names!r} and {of!r}."
            )
        if len(names) != len(of):
            raise ConfigError(
                f"system {name!r}: `{what}_units` must have one unit for each of the {len(names)} "
                f"`{what}_names`; got {len(of)}."
            )
    known = [*cls.state_names, *inputs]
    twice = sorted({n for n in known if known.count(n) > 1})
    if twice:
        raise ConfigError(f"system {name!r} has several columns called {', '.join(twice)}.")
    for triple in cls.position_derivatives:
        ties = not isinstance(triple, str) and len(triple) == 3
        if not (ties and {*triple[:2]} <= {*cls.state_names} and triple[2] in _FRAMES):
            raise ConfigError(
                f"system {name!r}: `position_derivatives` has (position, velocity, frame) for each pair of "
                f"states ({', '.join(cls.state_names)}), with a frame of {' or '.join(map(repr, _FRAMES))}; got "
                f"{triple!r}."
            )


def describe(cls: type[System]) -> None:
    """Fill in what a class of systems does not say of itself: errors and features are the state's."""
    names: tuple[str, ...] | None = getattr(cls, "state_names", None)
    units: tuple[str, ...] | None = getattr(cls, "state_units", None)
    if names is None or units is None:
        return
    _check_names(cls)
    if getattr(cls, "error_names", None) is None:
        cls.error_names = names
    if getattr(cls, "error_groups", None) is None and cls.error_names == names:
        kinds = {unit: tuple(k for k, u in enumerate(units) if u == unit) for unit in units}
        cls.error_groups = tuple(
            ErrorGroup("_".join(names[k] for k in channels), channels, unit)
            for unit, channels in kinds.items()
        )
    if getattr(cls, "feature_names", None) is None:
        cls.feature_names, cls.feature_units = names, units


def _only(cls: type[System]) -> tuple[Coordinate, ...]:
    """The coordinate of a machine that declares none: one position with its velocity, or one velocity, and one force.

    A velocity without its position is known by its unit, and by that of the port: what is added to a level, a
    temperature or a current is no force. Without it the dry friction of a motor (DCMotor.jl) was a dead band alone.
    """
    if list(cls.ports.values()) != [1] or len(cls.position_derivatives) > 1:
        return ()
    (port,), unit_of = cls.ports, dict(zip(cls.state_names, cls.state_units, strict=True))
    pairs = [(q, v) for q, v, frame in cls.position_derivatives if frame == "world"]
    if not cls.position_derivatives:
        speeds = [v for v, unit in unit_of.items() if unit in SPEEDS]
        pairs = [("", v) for v in speeds if len(speeds) == 1 and _pushes(cls, port, unit_of[v])]
    if not pairs:
        return ()
    ((q, v),) = pairs
    return (Coordinate(q or v, v, port, position=q),)


def _stores(cls: type[System]) -> tuple[Bound, ...]:
    """The levels, temperatures and voltages of a machine that has no coordinates: what may be stored beside each.

    None of a body in space, whose forces have effects of their own.
    """
    if Port.BODY_MOMENT in cls.ports:
        return ()
    positions = {q for q, _, _ in cls.position_derivatives}
    named = [k for k, n in enumerate(cls.state_names) if n not in positions]
    return tuple(_on_rate(cls, k, STORE, named=len(named) > 1) for k in named)


def _places(cls: type[System], declared: Sequence[Bound]) -> list[Bound]:
    """Positions of a machine of several coordinates that are none of them: a boat's in the world, a wheeled robot's."""
    if len(declared) < 2:
        return []
    taken = {k for at in declared for k in (at.position, at.velocity)}
    lengths = {dict(at.units)["position"] for at in declared}
    rest = [k for k, unit in enumerate(cls.state_units) if k not in taken and unit in lengths]
    return [_on_rate(cls, k, PLACE, named=True) for k in rest]


def _on_rate(cls: type[System], k: int, kind: str, *, named: bool) -> Bound:
    """A state whose own rate may be changed; `named`: whether its effects need its name."""
    name, unit = cls.state_names[k], cls.state_units[k]
    of = (("position", f"{unit} s"), ("speed", unit), ("force", units.of("speed/s", {"speed": unit})))
    place = (None, k, Port.RATE, k, len(cls.state_names))
    return Bound(name if named else "", *place, kind, of, name, "", name)


def _pushes(cls: type[System], port: Port, speed: str) -> bool:
    """Whether the unit of a port is that of a force or torque, or of one over the inertia of this speed."""
    if port not in cls.residual_ports:
        return True
    own = units.powers(cls.residual_ports[port].unit)
    return own in [units.powers(u) for u in ("N", "N m", "Nm", f"{speed}2")]


def made(system: System, name: str, values: Values | None = None) -> Effect:
    """An effect for a system, by the name that it has on it."""
    if is_law(name):
        return system.effect_class(name)(values, n_inputs=system.nu)
    if target_of(name):
        return difference_on(system, target_of(name))(values)
    return make_effect(
        name,
        system=system.name,
        ports={*system.ports, Port.INPUT},
        n_inputs=system.nu,
        values=values,
        coordinates=system.bound_coordinates(),
        inputs=system.single_inputs(),
    )


def all_made(system: System, items: Sequence[str | Effect], values: dict[str, Numbers]) -> list[Effect]:
    """Effects for a system, each checked; their values are taken out of `values`."""
    system.bound_coordinates()  # those that are declared wrong are reported even where no effect asks for one
    out = []
    for item in items:
        if isinstance(item, str):
            key = system.effect_key(item)
            item = made(system, key, values.pop(effect_class(key).name if ":" in key else key, None))
        check_effect(system, item)
        out.append(item)
    return out


def check_pushes(system: System, x: Tensor, u: Tensor) -> None:
    """Refuse a coordinate whose port does not push it: a force speeds up its own velocity, whatever the masses.

    With the first values of the machine, at states of the data (N, nx) and inputs there (N, nu + n_exogenous). The
    ConfigError names the coordinate, and what its push changes.
    """
    z = system.augment(x, u)
    with torch.no_grad():
        still = system.drift(0.0, z, u)
        for at in system.bound_coordinates():
            if at.port is Port.RATE:
                continue
            push = x.new_zeros(len(x), at.width)
            push[:, at.row] = 1.0
            change = (system.drift(0.0, z, u, {at.port: push}) - still)[:, : system.nx].median(0).values
            if float(change[at.velocity]) > 0:
                continue
            faster = [n for n, c in zip(system.state_names, change.tolist(), strict=True) if c > 0]
            raise ConfigError(
                f"coordinate {at.declared!r} of system {system.name!r}: a push on row {at.row} of the port "
                f"{at.port.value!r} does not speed up {system.state_names[at.velocity]!r} (it speeds up "
                f"{', '.join(faster) or 'nothing'}). Check `row` and `velocity` of the coordinate, the signs in "
                "`dynamics`, and that the first values of the parameters are those of a possible machine."
            )


@torch.no_grad()
def no_zero(system: System, name: str) -> str:
    """Why the zero of a position is no candidate, by the rates of some states; empty where it may be one."""
    biased = system.with_effects(system.make_effect(name)).double()
    effect = biased.effects[-1]
    assert isinstance(effect, Effect)
    x = torch.linspace(-0.9, 1.0, 7 * biased.nx, dtype=torch.float64).reshape(7, -1)
    u, rates = x.new_ones(7, biased.nu + len(biased.exogenous)), []
    for bias in (0.0, 0.05, 0.1):
        for key in effect.null:
            effect.set_value(key, x.new_tensor([bias]))
        rates.append(biased.drift(0.0, biased.augment(x, u), u))
    once, twice = ((rate - rates[0]).nan_to_num(0.0, 0.0, 0.0) for rate in rates[1:])
    if not bool(twice.any()):  # of a heading in the open
        return "nothing that is declared depends on that position"
    if torch.allclose(twice, 2.0 * once, rtol=1e-6, atol=1e-9 * float(twice.abs().max())):
        return "all that is declared is linear in that position, and a steady force is the same"
    return ""


def check_effect(system: System, effect: Effect) -> None:
    """Refuse an effect that reads what the system does not offer, or acts where it has no place."""
    has = offered(type(system))
    missing = [n for n, width in effect.quantities.items() if has.get(n) != width]
    if missing or (effect.quantities and effect.port is Port.INPUT):
        raise ConfigError(
            f"effect {effect.name!r} reads {', '.join(missing or effect.quantities)}, which system "
            f"{system.name!r} does not offer on the port {effect.port.value!r}. Leave the effect out."
        )
    if isinstance(effect, Law) and effect.at.place not in [at.place for at in system.bound_coordinates()]:
        raise ConfigError(
            f"effect {effect.name!r} was made for columns that are no coordinate of system {system.name!r}. Name it "
            f"in text, and it is made for the system: effects=[{effect.name!r}]."
        )
    if not (width := system.width_of(effect.port)):
        return  # `Effect.fits` says so where it is made by name
    like = next(effect.parameters(), torch.zeros(()))
    x = like.new_ones(2, system.nx)
    read = len(effect.exogenous) + sum(effect.quantities.values())
    u = like.new_ones(2, system.nu + read)
    step, effect.step = effect.step, 0.0
    try:
        with torch.no_grad():
            term = effect(0.0, x, u, effect.memory_start(x, u))
    except (IndexError, RuntimeError) as error:
        raise ConfigError(
            f"effect {effect.name!r} cannot be worked out on system {system.name!r}, whose state has "
            f"{system.nx} columns ({', '.join(system.state_names)}): {error}."
        ) from error
    finally:
        effect.step = step
    if tuple(term.shape) != (2, width):
        raise ConfigError(
            f"effect {effect.name!r} returns {tuple(term.shape[1:])} columns for the port {effect.port.value!r} of "
            f"system {system.name!r}, which has {width}. Return one column for each, or derive the effect from "
            "`nsde_torch.effects.Law`, which is made for one coordinate."
        )
