"""The library of terms that laws are built from: functions of the variables that a residual depends on.

    v^2, v^3, v^4, v^5, v, |v|, |v| v, sign v,   max(v - k, 0), min(v - k, 0) for zero and some k in the range of v,
    sin n v, cos n v of an angle,   a b, a^2 b, a b^2, |a| b, a |b|, max(a, 0) b, min(a, 0) b,
    sin a b, cos a b, sin a b^2, cos a b^2 with an angle a

Each is written in the grammar of `effects.expression_grammar`; k and the width of a sign are fitted with the size.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

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
