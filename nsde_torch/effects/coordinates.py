"""Coordinates: the ways in which a machine can move, each with its columns and the row of the port that pushes it.

Effects that are laws of one coordinate (`nsde_torch.effects.law`) are made for each coordinate that a system declares:
`coulomb_friction[q2]`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from nsde_torch.effects import units
from nsde_torch.effects.base import Port
from nsde_torch.errors import ConfigError

KINDS = ("rail", "joint", "axis")


@dataclass(frozen=True)
class Coordinate:
    """One way in which a machine can move, as a system declares it."""

    name: str  # what effects of it are called by: `coulomb_friction[NAME]`
    velocity: str  # state that is its velocity
    port: Port
    position: str = ""  # state that is its position; empty where none is logged
    row: int = 0  # row of the port, where that has several
    kind: str = "joint"
    """`rail` (along a line), `joint` (an angle within limits) or `axis` (turns without end)."""
    unit: str = ""
    """Unit of the port's row; empty: that of `residual_ports`, or unit of the velocity per second."""
    words: str = ""  # what reports call it: "the cart"; empty: its name
    load: str = ""
    """One of the system's `quantities`, one column wide: the load [any unit] that friction of it grows with."""


@dataclass(frozen=True)
class Bound:
    """A coordinate by columns of the state, otherwise as `Coordinate`."""

    name: str  # of the coordinate; empty of a machine's only one, whose effects have plain names
    position: int | None  # column of the position, or None
    velocity: int  # column of the velocity
    port: Port
    row: int
    width: int  # rows of the port
    kind: str
    units: tuple[tuple[str, str], ...]  # units of `position`, `speed` and `force` (what the port adds)
    words: str
    load: str = ""
    declared: str = ""  # name that the system gives it, of an only one too

    @property
    def place(self) -> tuple[int | None, int, Port, int, int]:
        """What decides where a law of it acts."""
        return self.position, self.velocity, self.port, self.row, self.width


PLAIN = Bound(
    "",
    0,
    1,
    Port.FORCE,
    0,
    1,
    "rail",
    (("position", "m"), ("speed", "m/s"), ("force", "m/s2")),
    "the motion",
)
"""The coordinate of a law that was not made for a machine: the only one of the simplest machines."""


def bound(
    declared: Sequence[Coordinate],
    *,
    system: str,
    state_names: Sequence[str],
    state_units: Sequence[str],
    ports: Mapping[Port, int],
    port_units: Mapping[Port, str],
    quantities: Mapping[str, int],
) -> tuple[Bound, ...]:
    """The coordinates of a system by columns.

    Args:
        port_units: Units of those ports of which it is known.
        quantities: What effects may read, name -> columns.

    Raises:
        ConfigError: a coordinate that does not fit the system; says which part of it.
    """
    names = [c.name for c in declared]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ConfigError(f"system {system!r} has two coordinates called {twice[0]!r}; names are unique.")
    out = []
    for c in declared:
        _check(c, system, state_names, ports, quantities)
        velocity = list(state_names).index(c.velocity)
        position = list(state_names).index(c.position) if c.position else None
        speed = state_units[velocity]
        force = c.unit or port_units.get(c.port) or units.of("speed/s", {"speed": speed})
        where = state_units[position] if position is not None else units.of("speed s", {"speed": speed})
        only = len(declared) == 1
        out.append(
            Bound(
                "" if only else c.name,
                position,
                velocity,
                c.port,
                c.row,
                ports[c.port],
                c.kind,
                (("position", where), ("speed", speed), ("force", force)),
                c.words or ("the motion" if only else c.name),
                c.load,
                c.name,
            )
        )
    return tuple(out)


def _check(
    c: Coordinate,
    system: str,
    state_names: Sequence[str],
    ports: Mapping[Port, int],
    quantities: Mapping[str, int],
) -> None:
    where = f"coordinate {c.name!r} of system {system!r}"
    if not c.name.isidentifier():
        raise ConfigError(f"{where}: its name must be a word, as effects are called by it: friction[q2].")
    for what, state in (("velocity", c.velocity), ("position", c.position)):
        if state not in state_names and not (what == "position" and not state):
            raise ConfigError(
                f"{where}: its {what} is {state!r}, which is no state; states are {', '.join(state_names)}."
            )
    if c.position == c.velocity:
        raise ConfigError(f"{where}: position and velocity are the same state {c.velocity!r}.")
    if c.port not in ports:
        raise ConfigError(
            f"{where}: port {c.port.value!r} is none of the system's: {', '.join(p.value for p in ports)}."
        )
    if not 0 <= c.row < ports[c.port]:
        raise ConfigError(
            f"{where}: row {c.row} is not on the port {c.port.value!r}, which has {ports[c.port]} (from 0)."
        )
    if c.kind not in KINDS:
        raise ConfigError(f"{where}: kind {c.kind!r} is none of {', '.join(KINDS)}.")
    if c.load and quantities.get(c.load) != 1:
        raise ConfigError(f"{where}: load {c.load!r} must be one of `quantities`, one column wide.")
