"""Laws of one coordinate: effects that are made for every coordinate of a machine.

    force on the coordinate = law(q, v)          q its position, v its velocity

`coulomb_friction[q2]` is the law `coulomb_friction` on the coordinate `q2`; a machine with one coordinate has plain
`coulomb_friction`. Terms are in the unit of the coordinate's port, which is a force over mass where the system is
written so.
"""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any, ClassVar

from torch import Tensor

from nsde_torch.effects import units
from nsde_torch.effects.base import Effect, Parameter, Port, in_row
from nsde_torch.effects.coordinates import MOVING, PLAIN, Bound
from nsde_torch.errors import ConfigError

AND = " + "
"""Between the names of effects that are there together."""

_NAME = re.compile(r"(.+)\[([^\[\]]+)\]")


def split_name(name: str) -> tuple[str, str]:
    """Law and coordinate of `law[coordinate]`; no coordinate of any other name."""
    found = _NAME.fullmatch(name)
    return (found[1], found[2]) if found else (name, "")


def joined_name(law: str, coordinate: str) -> str:
    """`law[coordinate]`, or the law alone where there is no coordinate."""
    return f"{law}[{coordinate}]" if coordinate else law


class Law(Effect):
    """An effect on one coordinate. Subclasses write `term`, with `self.q(x)` and `self.v(x)`.

    Units of `PARAMETERS` are products of `force`, `speed` and `position`: `force/speed` is 1/s where forces are over
    mass. In `sentence`, `{it}` is replaced by what moves.
    """

    port = Port.FORCE
    at: ClassVar[Bound] = PLAIN  # the coordinate; that of the simplest machine where none was given
    law: ClassVar[type[Law]]  # the law itself, of a class that was made of it for one coordinate
    kinds: ClassVar[tuple[str, ...]] = MOVING  # kinds of coordinates that it is for
    reads_position: ClassVar[bool] = False  # whether it is for coordinates whose position is known alone
    reads_load: ClassVar[bool] = False  # whether it is for coordinates that say their load (`self.load(u)`)
    reads_chain: ClassVar[bool] = False  # whether it is for one of several angles (`at.chain`)
    dry: ClassVar[bool] = False
    """Whether it is a dry friction: it holds what stands, and is a function of the speed of what moves alone."""
    _sentence: ClassVar[str] = ""

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        own = cls.__dict__
        if "law" in own:
            return
        cls.law = cls
        if "PARAMETERS" in own:
            cls.PARAMETERS = _in_units(cls._declared, PLAIN)
        if "sentence" in own:
            cls._sentence = own["sentence"]
            cls.sentence = cls._sentence.replace("{it}", PLAIN.words)

    @classmethod
    def suits(cls, at: Bound) -> bool:
        """Whether the law makes sense on a coordinate."""
        return (
            at.kind in cls.kinds
            and (at.position is not None or not cls.reads_position)
            and (bool(at.load) or not cls.reads_load)
            and (bool(at.chain) or not cls.reads_chain)
        )

    def q(self, x: Tensor) -> Tensor:
        """Position (N, 1), from the state."""
        k = self.at.position
        assert k is not None
        return x[:, k : k + 1]

    def v(self, x: Tensor) -> Tensor:
        """Velocity (N, 1), from the state."""
        return x[:, self.at.velocity : self.at.velocity + 1]

    def load(self, u: Tensor) -> Tensor:
        """Load of the coordinate (N, 1), from `u` of `term`."""
        return self.channel(self.at.load, u)

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """The term in the row of its coordinate, nothing in the others."""
        return in_row(self.term(t, x, u, memory), self.at.row, self.at.width)

    @abstractmethod
    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """What pushes the coordinate (N, 1); arguments as those of `Effect.forward`."""


def law_at(law: type[Law], at: Bound) -> type[Law]:
    """The effect that a law is on one coordinate; ConfigError where it makes no sense there."""
    law = law.law
    if not law.suits(at):
        what = f"that has a {'`load`' if law.reads_load else '`position`'}"
        what = "that is one of several angles [rad] of a port" if law.reads_chain else what
        what = f"of kind {' or '.join(law.kinds)}" if at.kind not in law.kinds else what
        raise ConfigError(
            f"effect {law.name!r} is for a coordinate {what}; {at.declared or at.name!r} is of kind {at.kind}."
        )
    return law if replace(at, declared="") == PLAIN else _made(law, at)


@cache
def _made(law: type[Law], at: Bound) -> type[Law]:
    return type_at(
        at.name,
        law,
        (law,),
        law=law,
        at=at,
        port=at.port if law.port is Port.FORCE else law.port,
        PARAMETERS=_in_units(law._declared, at),
        sentence=law._sentence.replace("{it}", at.words),
        quantities={**law.quantities, **({at.load: 1} if law.reads_load else {})},
    )


def type_at(place: str, effect: type[Effect], bases: tuple[type, ...], **own: Any) -> type[Any]:
    """The class of an effect in one place: what it includes and sizes of the data that it asks for are those there."""

    def there(name: str) -> str:
        return joined_name(name, place)

    sizes = {k: there(kind) if kind in _OF_PLACES else kind for k, kind in effect.relative.items()}
    what: dict[str, Any] = {"__module__": effect.__module__, "__doc__": effect.__doc__, "relative": sizes}
    names = {"__qualname__": there(effect.__qualname__), "name": there(effect.name)}
    includes = tuple(there(simple) for simple in effect.includes)
    return type(names["name"], bases, {**what, **names, "includes": includes, **own})


_OF_PLACES = ("position", "speed", "input")


def unplaced(law: type[Law], coordinate: str) -> type[Law]:
    """The effect that a law is on a coordinate of this name of some machine: what it is called and includes.

    Its columns and units are not those of the machine: nothing is computed with it.
    """
    return _made(
        law.law,
        replace(
            PLAIN,
            name=coordinate,
            words=coordinate,
            load="load" * law.reads_load,
            chain=((0, 0),) * law.reads_chain,
        ),
    )


def _in_units(declared: Mapping[str, Parameter], at: Bound) -> dict[str, Parameter]:
    known = dict(at.units)
    return {k: replace(p, unit=units.of(p.unit, known)) for k, p in declared.items()}
