"""Terms of laws as columns of the joint likelihood: what each would explain in the place of an effect.

A term moves a step as its value times the slope of the step in a force on its row of a port, which the filter's
linearisation holds already. A whole library costs one recursion, and no call of the machine.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.diagnosis.candidates import Start
from nsde_torch.diagnosis.law_terms import terms_of
from nsde_torch.inference import Optimum
from nsde_torch.inference.filtering import forced
from nsde_torch.inference.sensitivity import Grams, grams
from nsde_torch.systems import System
from nsde_torch.systems.vocabulary import seen_by, vocabulary

Array = NDArray[np.float64]

_AT_ONCE = 96  # columns of one recursion
_MOST_VALUES = 20_000  # rows that the first values of shapes are taken from


@dataclass(frozen=True)
class Term:
    """A law of one term.

    Args:
        law: Its text, with the size `c1`.
        start: First values of its shapes.
        port: Number of the disturbance that acts where it does.
    """

    law: str
    start: Start
    port: int


def terms_on(system: System, at: Optimum, port: int, names: Sequence[str]) -> list[Term]:
    """The library of terms of some states on one row of a port.

    Args:
        system: The machine.
        at: Its optimum.
        port: Number of the row among the disturbances of the likelihood.
        names: The states.
    """
    space = at.of.space
    where, column = space.disturbances[port]
    on = dict(vocabulary(type(system)).ports)[where.value].written(where.value)[column]
    counted = at.about.x[space.chunks.counted]
    rows = np.asarray(counted[:: max(1, len(counted) // _MOST_VALUES)].numpy())
    values = {name: rows[:, system.state_names.index(name)] for name in names}
    units = dict(zip(system.state_names, system.state_units, strict=True))
    terms = terms_of(list(names), values, [name for name in names if units[name] == "rad"])
    return [Term(system.effect_key(f"{on} = c1 {t.text}"), dict(t.start), port) for t in terms]


def tables(
    system: System, at: Optimum, base: Tensor, terms: Sequence[Term]
) -> Iterator[tuple[Sequence[Term], Grams]]:
    """Gram matrices of physics at its optimum and some terms, the base first; some terms at a time.

    Args:
        system: The machine.
        at: Its optimum.
        base: Columns of its parameters (T, C, ne, k).
        terms: The terms.
    """
    space = at.of.space
    for first in range(0, len(terms), _AT_ONCE):
        some = terms[first : first + _AT_ONCE]
        columns = torch.stack([_column(system, at, term) for term in some], -1)
        yield some, grams(space, at.levels, at.about, at.at, torch.cat((base, columns), -1))


@torch.no_grad()
def _column(system: System, at: Optimum, term: Term) -> Tensor:
    """What a term of size 1 does to the steps (T, C, ne)."""
    space, x = at.of.space, at.of.space.midway(at.about.x)
    effect = system.make_effect(term.law, {"c1": 1.0, **term.start}).double()
    flat, u, t = (part.flatten(0, 1) for part in (x, space.chunks.u, space.chunks.t[..., None]))
    seen = seen_by(system, effect, t[:, 0], torch.cat((flat, space.memory.flatten(0, 1)), 1), u)
    force = effect(t[:, 0], flat, seen, flat[:, :0]).sum(1).view(x.shape[:2])
    return forced(space, at.about, term.port, force)
