"""The library of terms that laws are built from, and what each would explain beside physics.

    v^2, v^3, v^4, v^5, v, |v|, |v| v, sign v,   max(v - k, 0), min(v - k, 0) for zero and some k in the range of v,
    sin n v, cos n v of an angle,   a b, a^2 b, a b^2, |a| b, a |b|, max(a, 0) b, min(a, 0) b,
    sin a b, cos a b, sin a b^2, cos a b^2 with an angle a

Each is written in the grammar of `effects.expression_grammar`; k and the width of a sign are fitted with the size. As a
column of the joint likelihood a term moves a step as its value times the slope of the step in a force on its row of a
port, which the filter's linearisation holds already. A whole library costs one recursion, and no call of the machine.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.diagnosis.candidates import Start
from nsde_torch.diagnosis.regressors import machine_variables
from nsde_torch.inference import Optimum
from nsde_torch.inference.filtering import filtered, forced
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.sensitivity import Grams, grams
from nsde_torch.systems import System
from nsde_torch.systems.vocabulary import seen_by, vocabulary

_KNOTS = (0.05, 0.2, 0.5, 0.8, 0.95)  # quantiles that hinges start from
_WIDTH = 0.05  # of a sign, of the 90 % quantile of the variable
_TURNS = (1, 2, 3)  # times an angle


@dataclass(frozen=True)
class LawTerm:
    """A term of a law, without its size."""

    text: str  # as the grammar has it
    start: tuple[tuple[str, float], ...] = ()  # first values of its shapes


def terms_of(names: Sequence[str], values: Mapping[str, Array], angles: Sequence[str]) -> list[LawTerm]:
    """Terms of some variables.

    Args:
        names: The variables, as the grammar has them.
        values: Their values (M,).
        angles: Those of them that are angles.
    """
    out: list[LawTerm] = []
    for name in names:
        out += _of_one(name, values[name], name in angles)
    for i, first in enumerate(names):
        for second in names[i + 1 :]:
            out += map(LawTerm, _of_two(first, second))
            for a, b in ((first, second), (second, first)):
                if a in angles:
                    out += [LawTerm(f"{f}({a}) {p}") for f in ("sin", "cos") for p in (b, f"{b}^2")]
    return out


def _of_one(name: str, v: Array, angle: bool) -> Iterator[LawTerm]:
    for text in (name, *(f"{name}^{n}" for n in (2, 3, 4, 5)), f"abs({name})", f"abs({name}) {name}"):
        yield LawTerm(text)
    size = max(float(np.quantile(np.abs(v), 0.9)), 1e-12)
    yield LawTerm(f"sign({name}, k1)", (("k1", _WIDTH * size),))
    for side in ("max", "min"):
        if v.min() < 0 < v.max():
            yield LawTerm(f"{side}({name}, 0)")
            yield LawTerm(f"{side}({name}, 0)^2")
        for knot in np.quantile(v, _KNOTS):
            yield LawTerm(f"{side}({name} - k1, 0)", (("k1", float(knot)),))
    for turns in _TURNS if angle else ():
        inner = name if turns == 1 else f"{turns} {name}"
        yield from (LawTerm(f"sin({inner})"), LawTerm(f"cos({inner})"))


def _of_two(a: str, b: str) -> Iterator[str]:
    yield from (f"{a} {b}", f"{a}^2 {b}", f"{a} {b}^2", f"abs({a}) {b}", f"{a} abs({b})")
    for side in ("max", "min"):
        yield from (f"{side}({a}, 0) {b}", f"{a} {side}({b}, 0)")


# ---- columns of the likelihood -------------------------------------------------------------------------

_AT_ONCE = 96  # columns of one recursion
_MOST_VALUES = 20_000  # rows that the first values of shapes are taken from


@dataclass(frozen=True)
class Term:
    """A law of one term."""

    law: str  # its text, with the size `c1`
    start: Start  # first values of its shapes
    port: int  # number of the disturbance that acts where it does


def with_places(system: System, names: Sequence[str]) -> list[str]:
    """Some variables, then angles of their sines and cosines, places of the speeds and speeds of the places among them.

    A friction that grows with the square of the place is odd in the speed, and shows nothing of the place.
    """
    states, beside = system.state_names, dict[str, str]()
    for at in system.bound_coordinates():
        if at.position is not None:
            place, speed = states[at.position], states[at.velocity]
            beside |= {place: speed, speed: place}
    angles = [n.removeprefix(f) for n in names for f in ("sin_", "cos_") if n.startswith(f)]
    known = [*names, *(a for a in angles if a in states)]
    return list(dict.fromkeys((*known, *(beside[n] for n in known if n in beside))))


def terms_on(system: System, at: Optimum, port: int, names: Sequence[str]) -> list[Term]:
    """The library of terms of some variables on one row of a port, without those that the machine has.

    Args:
        system: The machine.
        at: Its optimum.
        port: Number of the row among the disturbances of the likelihood.
        names: The variables; what a law cannot speak of is left out.
    """
    space, words = at.of.space, vocabulary(type(system))
    where, column = space.disturbances[port]
    on = dict(words.ports)[where.value].written(where.value)[column]
    counted = space.chunks.counted
    some = slice(None, None, max(1, int(counted.sum()) // _MOST_VALUES))
    x, u = at.x[counted][some], space.chunks.u[counted][some]
    table = machine_variables(system, x, u, inputs=True)
    table |= dict(zip(system.state_names, x[:, : system.nx].T, strict=True))
    known = [*(name for name, _, _ in words.variables), *system.exogenous]  # a product has one spelling
    there = [name for name in known if name in names and name in table]
    text = {name: f"logged({name})" if name in system.exogenous else name for name in there}
    units = {name: unit for name, unit, _ in words.variables}
    terms = terms_of(
        list(text.values()),
        {text[name]: table[name].numpy() for name in there},
        [text[name] for name in there if units.get(name) == "rad"],
    )
    out = [Term(system.effect_key(f"{on} = c1 {t.text}"), dict(t.start), port) for t in terms]
    return [term for term in out if term.law not in system.effect_names]


@torch.no_grad()
def tables(
    system: System, at: Optimum, terms: Sequence[Term], levels: Levels | None = None
) -> Iterator[tuple[Sequence[Term], Grams]]:
    """Gram matrices of physics at its optimum and some terms, its parameters first; some terms at a time.

    Args:
        system: The machine.
        at: Its optimum.
        terms: The terms.
        levels: Noise levels; None takes those of the optimum.
    """
    space, about = at.of.space, at.about
    base = space.columns(about.x, about.slopes, range(len(space.vector)), about.after)
    here = at.at
    if levels is None:
        levels = at.levels
    else:
        here = filtered(space, levels, about, at.of.start, space.chunks.counted)
    for first in range(0, len(terms), _AT_ONCE):
        some = terms[first : first + _AT_ONCE]
        columns = torch.stack([_column(system, at, term) for term in some], -1)
        yield some, grams(space, levels, about, here, torch.cat((base, columns), -1))


@torch.no_grad()
def _column(system: System, at: Optimum, term: Term) -> Tensor:
    """What a term of size 1 does to the steps (T, C, ne)."""
    space, x = at.of.space, at.of.space.midway(at.x)
    effect = system.make_effect(term.law, {"c1": 1.0, **term.start}).double()
    flat, u, t = (part.flatten(0, 1) for part in (x, space.chunks.u, space.chunks.t[..., None]))
    seen = seen_by(system, effect, t[:, 0], torch.cat((flat, space.memory.flatten(0, 1)), 1), u)
    force = effect(t[:, 0], flat, seen, flat[:, :0]).sum(1).view(x.shape[:2])
    return forced(space, at.about, term.port, force)
