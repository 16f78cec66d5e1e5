"""Functions of one and two variables: polynomials, also of sign and size, and Gaussian processes in reduced rank.

    f(s) = sum_j w_j sqrt(S(omega_j)) sin(omega_j (s + L)),    omega_j = j pi / 2 L,    S a Matern spectrum

on the range of the data scaled to [-1, 1], L = 1.5 (Solin and Sarkka, Statistics and Computing 30 (2020)). Functions of
two variables are products of few waves of each, and f(z_i) z_j with as many waves as a function of one has: a damping
or a gain that changes with the place (varying coefficients; Hastie and Tibshirani, Journal of the Royal Statistical
Society B 55 (1993)). Fine functions of one and of two have more waves and a length of a fifth of half the range; those
of two have the spectrum of the plane, which falls with their joint frequency.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Literal

import numpy as np

from nsde_torch.arrays import Array

Kind = Literal["polynomial", "signed", "product", "smooth", "fine", "varying", "past"]

_SIGN = 0.05  # of the root mean square: what a sign is rounded over
_REACH = 1.5  # L, of the half range of the data
_ONE, _TWO = 12, 5  # waves of one variable, and of each of two
_FINE, _FINE_LENGTH = 16, 0.2  # waves of each of two where they are fine, and length of their process
_LENGTH = 1.0  # of the Matern process with nu = 3/2, of the half range
EXTENDED: tuple[Kind, ...] = ("polynomial", "signed", "product")
"""Functions that go on beyond the data; waves say nothing about it."""


@dataclass(frozen=True)
class Scale:
    """How a variable is scaled: centre and half of its range, and its root mean square."""

    centre: float
    half: float
    size: float


def functions(
    of: Sequence[str], kind: Kind, values: Mapping[str, Array], scaled: Mapping[str, Scale]
) -> Array:
    """Values (n, q) of the functions of a group.

    Args:
        kind: `polynomial`, `signed` (sign of one, size, and square with its sign; of two, each times the size of the
            other), `product` of both, `smooth`, `fine`, or `varying`: waves of the first one times the second.
        values: Values of the variables (n,).
    """
    if kind in EXTENDED:
        plain = [values[name] / scaled[name].size for name in of]
        if kind == "product":
            return np.prod(plain, 0)[:, None]
        if kind == "signed" and len(plain) == 2:
            return np.stack((np.abs(plain[0]) * plain[1], plain[0] * np.abs(plain[1])), 1)
        if kind == "signed":
            size = np.abs(plain[0])
            return np.stack((np.tanh(plain[0] / _SIGN), size, plain[0] * size), 1)
        if len(plain) == 1:
            return np.stack([plain[0] ** k for k in (1, 2, 3)], 1)
        a, b = plain
        return np.stack((a * b, a * a * b, a * b * b), 1)
    ranged = [(values[name] - scaled[name].centre) / scaled[name].half for name in of]
    if kind == "varying":
        return _waves(ranged[0], _ONE) * (values[of[1]] / scaled[of[1]].size)[:, None]
    if kind == "fine":
        return _fine(*ranged)
    if len(ranged) == 1:
        return _waves(ranged[0], _ONE)
    first, second = (_waves(s, _TWO) for s in ranged)
    return (first[:, :, None] * second[:, None, :]).reshape(len(first), -1)


def _waves(s: Array, count: int) -> Array:
    """Waves (n, count) whose weights have a prior of one variance."""
    waves, omega = _sines(s, count)
    spectrum = (3.0 / _LENGTH**2 + omega**2) ** -2.0
    return np.asarray(waves * np.sqrt(spectrum / spectrum.sum()))


def _fine(*ranged: Array) -> Array:
    """Products of waves of one or two variables (n, q) up to one joint frequency, with a prior of one variance."""
    waves, omega = zip(*(_sines(s, _FINE) for s in ranged), strict=True)
    squared = reduce(np.add.outer, [w**2 for w in omega])
    at = np.nonzero(squared <= omega[0][-1] ** 2 * (1.0 + 1e-9))
    spectrum = (3.0 / _FINE_LENGTH**2 + squared[at]) ** -(1.5 + 0.5 * len(ranged))
    out = reduce(np.multiply, [w[:, k] for w, k in zip(waves, at, strict=True)])
    return np.asarray(out * np.sqrt(spectrum / spectrum.sum()))


def _sines(s: Array, count: int) -> tuple[Array, Array]:
    """Sines (n, count) that vanish at the ends of [-L, L], and their frequencies (count,)."""
    omega = np.arange(1, count + 1) * np.pi / (2.0 * _REACH)
    waves = np.sin(omega * (np.clip(s, -_REACH, _REACH)[:, None] + _REACH))
    return np.asarray(waves), np.asarray(omega)
