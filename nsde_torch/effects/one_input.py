"""Effects on one input of several: `actuator_lag[rudder]` is the effect `actuator_lag` on the input `rudder` alone.

A machine whose inputs have drives of their own has each for every input. Where two inputs share one lag, the effect on
all of them says so with one number. Without these, a boat whose rudder alone acts late was `unexplained`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import ClassVar

from torch import Tensor

from nsde_torch.effects.base import Effect, Port, in_row
from nsde_torch.effects.law import type_at


@dataclass(frozen=True)
class Input:
    """One input of several, by its column."""

    name: str
    unit: str
    column: int
    of: int  # number of inputs


UNPLACED = Input("", "input", 0, 1)
"""The input of an effect that was not made for a machine."""


def single_inputs(names: Sequence[str], units: Sequence[str], ports: Collection[Port]) -> tuple[Input, ...]:
    """The inputs that may have a drive of their own; none of a machine with one, or of rotors, which are alike."""
    if len(names) < 2 or Port.BODY_MOMENT in ports:
        return ()
    return tuple(Input(n, unit, k, len(names)) for k, (n, unit) in enumerate(zip(names, units, strict=True)))


class OnOneInput(Effect):
    """What makes an effect on all inputs one on a single input: classes of `on_input` derive from it and the effect."""

    at: ClassVar[Input] = UNPLACED
    of_all: ClassVar[type[Effect]]  # the effect that it is of

    def __init__(self, values: Mapping[str, float | list[float]] | None = None, *, n_inputs: int = 1) -> None:
        super().__init__(values, n_inputs=1)

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """The change of its own input, nothing for the others."""
        own = super().forward(t, x, self._own(u), memory)  # type: ignore[safe-super]
        return in_row(own, self.at.column, self.at.of)

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return super().memory_rate(t, x, self._own(u), memory)

    def held(self, u: Tensor, dt: float) -> Tensor | None:
        return super().held(self._own(u), dt)

    def memory_start(self, x: Tensor, u: Tensor) -> Tensor:
        return super().memory_start(x, self._own(u))

    def _own(self, u: Tensor) -> Tensor:
        return u[:, self.at.column : self.at.column + 1]


@cache
def on_input(effect: type[Effect], at: Input) -> type[Effect]:
    """The effect on one input alone, with its unit."""
    units = {k: replace(p, unit=in_unit(p.unit, at.unit)) for k, p in effect.PARAMETERS.items()}
    sentence = f"On {at.name} alone: {effect.sentence}"
    own = {"at": at, "of_all": effect, "PARAMETERS": units, "sentence": sentence}
    return type_at(at.name, effect, (OnOneInput, effect), **own)


def in_unit(unit: str, of_input: str) -> str:
    """A unit with that of the input in place of `input`."""
    word, slash, rest = unit.partition("/")
    return f"{of_input}{slash}{rest}" if word == "input" and of_input != "input" else unit


def of_several_units(effect: type[Effect], units: Collection[str]) -> bool:
    """Whether an effect on all inputs has one number for inputs of several units."""
    return len(set(units)) > 1 and any(in_unit(p.unit, "") != p.unit for p in effect.PARAMETERS.values())
