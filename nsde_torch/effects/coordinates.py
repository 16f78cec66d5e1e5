"""Coordinates: the ways in which a machine can move, each with its columns and the row of the port that pushes it.

Effects that are laws of one coordinate (`nsde_torch.effects.law`) are made for each coordinate that a system declares:
`coulomb_friction[q2]`.
"""

from __future__ import annotations

from dataclasses import dataclass

from nsde_torch.effects.base import Port

MOVING = ("rail", "joint", "axis")
"""Kinds of coordinates that move."""
STORE = "store"
"""Kind of what is a level, a temperature, a charge or a voltage, and moves nothing."""
KINDS = (*MOVING, STORE)
PLACE = "place"
"""Kind of a position whose rate is worked out of velocities, as a boat's in the world; none that is declared."""


@dataclass(frozen=True)
class Coordinate:
    """One way in which a machine can move, as a system declares it."""

    name: str  # what effects of it are called by: `coulomb_friction[NAME]`
    velocity: str  # state that is its velocity
    port: Port
    position: str = ""  # state that is its position; empty where none is logged
    row: int = 0  # row of the port, where that has several
    kind: str = ""
    """`rail` (along a line), `joint` (an angle within limits), `axis` (turns without end) or `store` (no motion);
    empty: `joint` where its position is an angle, else `rail`."""
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
    kind: str  # one of `KINDS`, or `PLACE`
    units: tuple[tuple[str, str], ...]  # units of `position`, `speed` and `force` (what the port adds)
    words: str
    load: str = ""
    declared: str = ""  # name that the system gives it, of an only one too
    chain: tuple[tuple[int, int], ...] = ()
    """Row and column of the position of each angle from the first of its port to its own; empty of an only one."""

    @property
    def place(self) -> tuple[int | None, int, Port, int, int]:
        """What decides where a law of it acts."""
        return self.position, self.velocity, self.port, self.row, self.width


PLAIN = Bound(
    "", 0, 1, Port.FORCE, 0, 1, "rail", (("position", "m"), ("speed", "m/s"), ("force", "m/s2")), "the motion"
)
"""The coordinate of a law that was not made for a machine: the only one of the simplest machines."""
