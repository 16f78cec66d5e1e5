"""The library of terms that laws are built from, and what each would explain beside physics.

    1, v^2, v^3, v^4, v^5, v, c1 + c2 v, |v|, |v| v, sign v,
    max(v - k, 0), min(v - k, 0) for zero and some k in the range of v,
    2 v k / (v^2 + k^2), which is largest at k,   what pulls to a place of no speed, d / k exp(1/2 - d^2 / (2 k^2)),
    sign(d) about a place, as a spring under preload has,   exp(-(d / k)^8), which is there between two places alone,
    exp(k v) - 1 of no speed, beside a constant too,   sin n v, cos n v of an angle,
    |v|^k with the sign of v, of v, of max(v - p, 0) and min(v - p, 0), and of v - p with p beyond the range of v,
    max(min(v, k), -k): what is left out by play,   |a|^k b and (exp(k a) - 1) b of an a of one sign,
    a b, a^2 b, a b^2, |a| b, a |b|, max(a, 0) b, min(a, 0) b, root a b of what has one sign,
    c1 a^n + c2 b^n of one unit with n = 2, 4,
    sin n a b, cos n a b, sin n a b^2, cos n a b^2 with an angle a and n = 1, 2,   planes c1 a + c2 b,
    a sign b, a^2 sign b, |a| sign b, sin n a sign b, cos n a sign b with a speed b, each also beside c1 sign b

A variable may be the difference of two states, or of a state and an input, of one unit. Each is written in the grammar
of `effects.expression_grammar`; k and the width of a sign are fitted with the size. As a column of the joint likelihood
a term moves a step as its value times the slope of the step in a force on its row of a port, which the filter's
linearisation holds already. A whole library costs one recursion, and no call of the machine.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.diagnosis.candidates import Start
from nsde_torch.diagnosis.regressors import machine_variables
from nsde_torch.effects.by_run import RUN
from nsde_torch.inference import Optimum
from nsde_torch.inference.filtering import filtered, forced
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.sensitivity import Grams, grams
from nsde_torch.systems import System
from nsde_torch.systems.vocabulary import seen_by, vocabulary

_KNOTS = (0.05, 0.2, 0.5, 0.8, 0.95)  # quantiles that hinges start from
_SELDOM = 0.01  # share of values of the other sign that is noise
_WIDTH = 0.05  # of a sign, of the 90 % quantile of the variable
# of what saturates. From the narrow one alone 1.6 tanh(r / 0.9) of a helicopter's yaw was a peak and a cube
_SATURATES = 0.4
_TURNS = (1, 2, 3)  # times an angle
_NAME = r"(\w+|\(\w+ - \w+\))"  # of a variable, or of the difference of two
_DIFFERENCE = re.compile(r"\((\w+) - (\w+)\)")
# at one end of k1: the variable
_CURVED = re.compile(rf"(?:sign|peak)\({_NAME}, k1\)|expm1\(k1 {_NAME}\)")
_ABOUT_A_PLACE = re.compile(rf"(\w+)\({_NAME} - k1, (k2|0)\)")  # the function, its variable, its width
_POWER = re.compile(r"pow\((.+), k[12]\)")
_COSINE = re.compile(rf"cos\((?:\d )?{_NAME}\) | cos\((?:\d )?{_NAME}\)$")  # as a factor
_WAVE = re.compile(rf"(sin|cos)\((?:\d )?{_NAME}\)")
# an eddy brake, largest at 8 rad/s, was five laws of the speed beside one another; a spring of rubber had no form
_PEAKS = (0.2, 0.6)  # where a peak lies, of the same quantile
_PLACES = tuple(k / 12.0 for k in range(1, 12))  # quantiles that pulls start from
_PULLS = (0.03, 0.08, 0.2)  # and how far these reach, of the range
_EXPONENTS = (-2.0, -0.7, 0.7, 2.0)  # at the same quantile
_OVER_THE_RANGE = (-3.0, 3.0)  # exponents, over the range of a variable
_POWERS = (0.5, 1.5, 2.5)  # that powers start from
_BEYOND = (0.2, 1.0)  # how far beyond the range of a variable a pole starts, of the range


@dataclass(frozen=True)
class LawTerm:
    """What a law consists of, without its sizes."""

    parts: tuple[str, ...]  # what each size multiplies, as the grammar has it
    start: tuple[tuple[str, float], ...] = ()  # first values of its shapes


def terms_of(names: Sequence[str], values: Mapping[str, Array], units: Mapping[str, str]) -> list[LawTerm]:
    """Terms of some variables, with values (M,) and units, by their names in the grammar.

    Some are angles, and some speeds: nothing brakes exponentially.
    """
    out: list[LawTerm] = []
    angles, speeds = ([n for n in names if units.get(n) in some] for some in (("rad",), ("m/s", "rad/s")))
    for name in names:
        out += _of_one(name, values[name], name in angles, name in speeds)
    for i, first in enumerate(names):
        for second in names[i + 1 :]:
            if _words(first) & _words(second) or first[0] == second[0] == "(":
                continue
            if first in units and units[first] == units.get(second) and "(" not in (first[0], second[0]):
                # gas in a pipe, radiation
                out += [LawTerm((f"{first}^{n}", f"{second}^{n}")) for n in (2, 4)]
            signed = [name for name in (first, second) if has_both_signs(values[name])]
            flows = [
                name
                for name in (first, second)
                if name not in signed and not (name in angles or name in speeds)
            ]
            out += [LawTerm((text,)) for text in _of_two(first, second, signed, flows)]
            # an eddy brake grows as its gap closes: `v / z` was a viscous friction 16 times too large, and two laws
            for a, b in ((first, second), (second, first)):
                if not (a in signed or a in angles):
                    out.append(LawTerm((f"pow({a}, k1) {b}",), (("k1", -1.0),)))
                # a reaction is faster where it is hot
                for exponent in _OVER_THE_RANGE if a in flows else ():
                    start = exponent / max(float(np.ptp(values[a])), 1e-12)
                    out.append(LawTerm((f"expm1(k1 {a}) {b}",), (("k1", start),)))
            # two propellers that push a boat sideways: the product of both was named, which explained three quarters
            out.append(LawTerm((first, second)))
            for a, b in ((first, second), (second, first)):
                waves = (
                    [f"{f}({turn}{a})" for f in ("sin", "cos") for turn in ("", "2 ")] if a in angles else []
                )
                out += [LawTerm((f"{wave} {p}",)) for wave in waves for p in (b, f"{b}^2")]
                # guides of a lift that rub with the square of the height, a joint that rubs twice a turn, a cylinder
                # whose seals rub by the pressure were Stribeck's friction and stops
                if b in speeds and has_both_signs(values[b]):
                    of_place = [a, f"{a}^2", *[f"abs({a})"][: a in signed], *waves]
                    width = (("k1", _WIDTH * _size(values[b])),)
                    sign = f"sign({b}, k1)"
                    out += [LawTerm((f"{text} {sign}",), width) for text in of_place]
                    out += [LawTerm((sign, f"{text} {sign}"), width) for text in of_place]
    return out


def _words(name: str) -> set[str]:
    return {*re.findall(r"\w+", name)}


def _size(v: Array) -> float:
    return max(float(np.quantile(np.abs(v), 0.9)), 1e-12)


def has_both_signs(v: Array) -> bool:
    """Whether values (M,) are more than now and then of either sign.

    Of those that are not, sizes and sides are no terms of their own: the yaw of a vehicle that only goes ahead was
    `u v` and `abs(u) v`, and provisional.
    """
    low, high = np.quantile(v, (_SELDOM, 1.0 - _SELDOM))
    return bool(low < 0 < high)


def _of_one(name: str, v: Array, angle: bool, speed: bool) -> Iterator[LawTerm]:
    signed = has_both_signs(v)
    for text in (name, *(f"{name}^{n}" for n in (2, 3, 4, 5))):
        yield LawTerm((text,))
    yield LawTerm(("", name))  # what is lost to the surroundings
    if not (speed or angle):  # what flows through a hole or a valve
        yield LawTerm((f"root({name})",))
    for text in (f"abs({name})", f"abs({name}) {name}") if signed else ():
        yield LawTerm((text,))
    size = _size(v)
    for share in (_WIDTH, _SATURATES):
        yield LawTerm((f"sign({name}, k1)",), (("k1", share * size),))
    for share in _PEAKS:
        yield LawTerm((f"peak({name}, k1)",), (("k1", share * size),))
    # of speeds the public drive EMPS had four laws in the place of a dry friction and a steady force
    for exponent in () if speed else _EXPONENTS:
        for parts in ((f"expm1(k1 {name})",), ("", f"expm1(k1 {name})")):
            yield LawTerm(parts, (("k1", exponent / size),))
    yield from _powers(name, v, signed, angle, speed)
    for share in _PEAKS if signed else ():
        yield LawTerm((f"max(min({name}, k1), -k1)",), (("k1", share * size),))
    for side in ("max", "min"):
        if signed:
            yield LawTerm((f"{side}({name}, 0)",))
            yield LawTerm((f"{side}({name}, 0)^2",))
        for knot in np.quantile(v, _KNOTS):
            yield LawTerm((f"{side}({name} - k1, 0)",), (("k1", float(knot)),))
    # magnets beside a rail were eight terms that cancelled one another
    for knot, share in product(np.quantile(v, _PLACES), _PULLS) if not speed else ():
        start = ("k1", float(knot)), ("k2", share * float(np.ptp(v)))
        yield LawTerm((f"pull({name} - k1, k2)",), start)
        # a slope of 6 m on the way of a wheelchair was a dry friction that came and went at eight moments, surely
        yield LawTerm((f"window({name} - k1, k2)",), start)
    # the spring of a throttle that rests under preload was a magnet, a ripple and two waves
    for knot in np.quantile(v, _PLACES) if not speed else ():
        yield LawTerm((f"sign({name} - k1, k2)",), (("k1", float(knot)), ("k2", _WIDTH * float(np.ptp(v)))))
    for turns in _TURNS if angle else ():
        inner = name if turns == 1 else f"{turns} {name}"
        yield from (LawTerm((f"sin({inner})",)), LawTerm((f"cos({inner})",)))


def _powers(name: str, v: Array, signed: bool, angle: bool, speed: bool) -> Iterator[LawTerm]:
    """Powers that need not be whole; a speed has no level, and neither it nor an angle has a pole.

    Seals rub with v^1.5, air carries heat off with the difference to 1.25, a weir lets out (h - k)^1.5, a ball on a
    plate and a cable that comes tight push back so, and what leaks through a hole at k goes with (h - k)^0.5: each was
    two to five other laws.
    """
    for to in (*_POWERS, *(() if signed or angle or speed else (-1.0,))):
        yield LawTerm((f"pow({name}, k1)",), (("k1", to),))
    if speed:
        return
    for side, knot, to in product(("max", "min"), np.quantile(v, _KNOTS), _POWERS[:2]):
        yield LawTerm((f"pow({side}({name} - k1, 0), k2)",), (("k1", float(knot)), ("k2", to)))
    if angle:
        return
    low, high = np.quantile(v, (0.0, 1.0))
    for pole in (
        end + side * share * (high - low) for side, end in ((-1, low), (1, high)) for share in _BEYOND
    ):
        for parts in ((f"pow({name} - k1, k2)",), ("", f"pow({name} - k1, k2)")):
            yield LawTerm(parts, (("k1", float(pole)), ("k2", -1.0)))


def _of_two(a: str, b: str, signed: Sequence[str], flows: Sequence[str]) -> Iterator[str]:
    yield from (f"{a} {b}", f"{a}^2 {b}", f"{a} {b}^2")
    for one, other in ((a, b), (b, a)):
        if one in signed:
            for of_it in (f"abs({one})", f"max({one}, 0)", f"min({one}, 0)"):
                yield f"{of_it} {other}" if one == a else f"{other} {of_it}"
        elif one in flows:  # what is exchanged with a stream goes with the root of it
            yield f"root({one}) {other}" if one == a else f"{other} root({one})"


# ---- columns of the likelihood -------------------------------------------------------------------------

_AT_ONCE = 64  # laws of one recursion
_MOST_VALUES = 20_000  # rows that the first values of shapes are taken from


@dataclass(frozen=True)
class Term:
    """A law of the library."""

    law: str  # its text, with the sizes `c1`, `c2`
    parts: tuple[str, ...]  # what each size multiplies
    start: Start  # first values of its shapes
    port: int  # number of the disturbance that acts where it does

    @property
    def sizes(self) -> tuple[str, ...]:
        """Names of its sizes."""
        return _sizes(self.parts)

    def contains(self, other: Term) -> bool:
        """Whether another law is this one with a size of 0, or at one value of its shapes.

        A wide sign is a line, one about a place of 0 a plain one, and a wave of any length one of two a turn: of two
        laws of a motor's inverter, each exact, one was provisional because of the place.
        """
        if self.port != other.port:
            return False
        if set(other.parts) < set(self.parts):
            return True
        # nor is one of a state less another that hardly moves: of a boat's drag `abs(turn) (surge - sway)`; nor one
        # times the cosine of an angle that hardly turns: of a torque `theta_dot v` of a robot that stands upright
        simpler = [(_DIFFERENCE, r"\1"), (_DIFFERENCE, r"\2"), (_COSINE, "")]
        if any(
            {*map(_words_of, other.parts)} == {_words_of(of.sub(left, part)) for part in self.parts}
            for of, left in simpler
        ):
            return set(other.parts) != set(self.parts)
        if not self.start:
            return False
        whole = [rf"\1{more}" for more in ("", "^2", "^3", "^4", "^5")]
        if any(
            set(other.parts) == {_POWER.sub(of, part) for part in self.parts}
            for of in (*whole, r"root(\1)", r"abs(\1) \1", r"sign(\1, k1)")
        ):
            return set(other.parts) != set(self.parts)
        straight = {_CURVED.sub(r"\1\2", part) for part in self.parts}
        central = {_ABOUT_A_PLACE.sub(_central, part) for part in self.parts}
        of_one_length = {_WAVE.sub(r"\1(k1 \2)", part) for part in other.parts}
        return set(other.parts) in (straight, central) or of_one_length <= set(self.parts)


def _words_of(part: str) -> tuple[str, ...]:
    return tuple(sorted(part.split(" ")))


def _central(found: re.Match[str]) -> str:
    function, name, width = found.groups()
    return f"{function}({name}, {'k1' if width == 'k2' else width})"


def _sizes(parts: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"c{n + 1}" for n in range(len(parts)))


def with_places(system: System, names: Sequence[str]) -> list[str]:
    """Some variables, angles for their sines and cosines; then places of the speeds among them, speeds of the places.

    A friction that grows with the square of the place is odd in the speed, and shows nothing of the place.
    """
    states, beside = system.state_names, dict[str, str]()
    for at in system.bound_coordinates():
        if at.position is not None:
            place, speed = states[at.position], states[at.velocity]
            beside |= {place: speed, speed: place}
    # its sine and cosine are laws of the angle: `cos(theta) x_dot` and `x_dot cos_theta` were one law, and a tie
    known = [n.removeprefix("sin_").removeprefix("cos_") for n in names]
    known = [angle if angle in states else n for angle, n in zip(known, names, strict=True)]
    return list(dict.fromkeys((*known, *(beside[n] for n in known if n in beside))))


def terms_on(system: System, at: Optimum, port: int, names: Sequence[str]) -> list[Term]:
    """The library of terms of some variables on one row of a port, without those that the machine has.

    Variables that a law cannot speak of are left out; `port` is the number of a disturbance of the likelihood.
    """
    space, words = at.of.space, vocabulary(type(system))
    counted = space.chunks.counted
    some = slice(None, None, max(1, int(counted.sum()) // _MOST_VALUES))
    x, u = at.x[counted][some], space.chunks.u[counted][some]
    table = machine_variables(system, x, u, inputs=True)
    table |= dict(zip(system.state_names, x[:, : system.nx].T, strict=True))
    logged = [name for name in system.exogenous if name != RUN]
    known = [*(name for name, _, _ in words.variables), *logged]  # a product has one spelling
    there = [name for name in known if name in names and name in table]
    text = {name: f"logged({name})" if name in system.exogenous else name for name in there}
    units = {text[name]: unit for name, unit, _ in words.variables if name in text}
    values = {text[name]: table[name].numpy() for name in there}
    # heat, liquids and springs go by differences: of a heat exchanger that a stream cools, laws of both temperatures
    # stood beside one another, and each by itself was sure
    states = [] if system.quaternion is not None else [n for n in there if n in system.state_names]
    inputs = [n for n in there if n in system.input_names] if states else []
    for a, b in (*combinations(states, 2), *product(states, inputs)):
        apart = values[a] - values[b]
        # what is a variable by itself has one name: an angle of attack was a path less an attitude too
        same = any(
            np.allclose(apart, sign * v, atol=1e-6 * _size(v)) for v in values.values() for sign in (1, -1)
        )
        if units[a] == units[b] and not same:
            units[f"({a} - {b})"], values[f"({a} - {b})"] = units[a], apart
    terms = [LawTerm(("",))] if there else []
    terms += terms_of(list(values), values, units)
    out = [law_on(system, at, port, term.parts, dict(term.start)) for term in terms]
    return [term for term in out if term.law not in system.effect_names]


def law_on(system: System, at: Optimum, port: int, parts: tuple[str, ...], start: Start) -> Term:
    """A law on one row of a port, of parts as the grammar has them, one a size; an empty one is a constant."""
    where, column = at.of.space.disturbances[port]
    on = dict(vocabulary(type(system)).ports)[where.value].written(where.value)[column]
    summed = " + ".join(f"{c} {part}".strip() for c, part in zip(_sizes(parts), parts, strict=True))
    return Term(system.effect_key(f"{on} = {summed}"), parts, start, port)


@torch.no_grad()
def tables(
    system: System, at: Optimum, terms: Sequence[Term], levels: Levels | None = None
) -> Iterator[tuple[Sequence[tuple[Term, tuple[int, ...]]], Grams]]:
    """Some laws at a time, each with its columns (one for each size), and Gram matrices of physics first and these.

    Noise levels are those of the optimum where none are given.
    """
    space, about = at.of.space, at.about
    base = space.columns(about.x, about.slopes, range(len(space.vector)), about.after)
    middle, here = space.midway(about.x, about.after), at.at
    if levels is None:
        levels = at.levels
    else:
        here = filtered(space, levels, about, space.chunks.counted)
    for first in range(0, len(terms), _AT_ONCE):
        some, columns, moved = list[tuple[Term, tuple[int, ...]]](), 1 + base.shape[-1], [base]
        for term in terms[first : first + _AT_ONCE]:
            some.append((term, tuple(range(columns, columns + len(term.sizes)))))
            columns += len(term.sizes)
            moved += [_column(system, at, middle, term, size)[..., None] for size in term.sizes]
        yield some, grams(space, levels, about, here, torch.cat(moved, -1))


@torch.no_grad()
def _column(system: System, at: Optimum, x: Tensor, term: Term, size: str) -> Tensor:
    """What a law does to the steps (T, C, ne), by states in their middle, where one size is 1 and the others are 0."""
    space = at.of.space
    effect = system.make_effect(
        term.law, {**dict.fromkeys(term.sizes, 0.0), size: 1.0, **term.start}
    ).double()
    flat, u, t = (part.flatten(0, 1) for part in (x, space.chunks.u, space.chunks.t[..., None]))
    z = space.with_memory(flat, space.memory.flatten(0, 1))
    seen, flat = seen_by(system, effect, t[:, 0], z, u), flat[:, : system.nx]
    force = effect(t[:, 0], flat, seen, flat[:, :0]).sum(1).view(x.shape[:2])
    return forced(space, at.about, term.port, force)
