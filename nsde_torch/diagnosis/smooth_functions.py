"""Smooth functions of one variable and of two: what a flexible model of a residual is a sum of.

    f(z) = c + sum_i f_i(z_i) + sum_{i<j} f_ij(z_i, z_j)             (functional analysis of variance; GA2M)

(Wahba and others, Annals of Statistics 23 (1995); Duvenaud, Nickisch and Rasmussen, NIPS 2011.) Each f is a polynomial
of low degree, which goes on beyond the data, plus a Gaussian process in its reduced rank,

    f(s) = sum_j w_j sqrt(S(omega_j)) sin(omega_j (s + L)),    omega_j = j pi / 2 L,    S a Matern spectrum

on the range of the data scaled to [-1, 1], L = 1.5 (Solin and Sarkka, Statistics and Computing 30 (2020)). Functions of
two variables are products of few waves of each, and f(z_i) z_j with as many waves as a function of one has: a damping
or a gain that changes with the place (varying coefficients; Hastie and Tibshirani, Journal of the Royal Statistical
Society B 55 (1993)). Fine functions of one and of two have more waves and a length of a fifth of half the range; those
of two have the spectrum of the plane, which falls with their joint frequency. Beside these stand inputs as they were
before, and variables that act more or less in the course of a run.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nsde_torch.diagnosis.regressors import BEFORE, OVER_TIME, Regressors

Array = NDArray[np.float64]
Kind = Literal["constant", "polynomial", "smooth", "fine", "varying", "past"]

_REACH = 1.5  # L, of the half range of the data
_ONE, _TWO = 12, 5  # waves of one variable, and of each of two
_FINE, _FINE_LENGTH = 16, 0.2  # waves of each of two where they are fine, and length of their process
_FEWEST = 4  # variables up to which processes of two are tried at once
_FEW = 8  # variables beyond which products alone are
_LENGTH = 1.0  # of the Matern process with nu = 3/2, of the half range
_FLAT = 1e-9  # spread below which a column says nothing


@dataclass(frozen=True)
class Scale:
    """How a variable is scaled: centre and half of its range, and its root mean square."""

    centre: float
    half: float
    size: float


@dataclass(frozen=True)
class FunctionGroup:
    """Functions that are chosen together and share one prior variance.

    Args:
        variables: What they are functions of; empty for the constant.
        kind: What they are.
        width: Number q of them.
        made: Makes their values: those of all groups together are a hundred times as many as the data.
    """

    variables: tuple[str, ...]
    kind: Kind
    width: int
    made: Callable[[], Array]

    @property
    def columns(self) -> Array:
        """Their values in the middle of each box (M, q), made anew."""
        return self.made()[:, : self.width]


def scales(variables: Regressors) -> dict[str, Scale]:
    """Scales of the variables that functions are of: an angle whose sine and cosine are there is not one of them."""
    columns = variables.columns
    out = {}
    for name, v in columns.items():
        if f"sin_{name}" in columns and f"cos_{name}" in columns:
            continue
        low, high = float(v.min()), float(v.max())
        size = float(np.sqrt(np.square(v).mean()))
        if high - low > _FLAT * max(size, _FLAT):
            out[name] = Scale(0.5 * (low + high), 0.5 * (high - low), size)
    return out


def first_groups(variables: Regressors, scaled: Mapping[str, Scale], *, pairs: bool) -> list[FunctionGroup]:
    """All groups; of many variables, processes of two join later, where their polynomial was chosen.

    Args:
        variables: Values of the variables.
        scaled: Their scales.
        pairs: Whether functions of two variables are among them.
    """
    names, values = list(scaled), variables.columns
    out = [FunctionGroup((), "constant", 1, partial(np.ones, (len(variables.t), 1)))]
    out += [
        _group((name,), kind, values, scaled) for name in names for kind in ("polynomial", "smooth", "fine")
    ]
    for name, (functions_before, _) in variables.functions.items():
        if name.endswith((BEFORE, OVER_TIME)) and name.partition(" ")[0] in scaled:
            spread = functions_before.std(0)
            live = int((spread > _FLAT).sum())
            if live:
                out.append(FunctionGroup((name,), "past", live, partial(_past, functions_before, spread)))
    for i, first in enumerate(names if pairs else []):
        for second in names[i + 1 :]:
            both = (first, second)
            products = _group(both, "polynomial", values, scaled)
            out.append(products if len(names) <= _FEW else replace(products, width=1))
            if len(names) <= _FEWEST:
                out += processes_of_two(both, values, scaled)
    return out


def processes_of_two(
    of: tuple[str, str], values: Mapping[str, Array], scaled: Mapping[str, Scale]
) -> list[FunctionGroup]:
    """Groups of functions of two variables beside their polynomial: of both, fine ones too, and each times the other.

    Args:
        of: The variables.
        values: Values of the variables (n,).
        scaled: Their scales.
    """
    kinds: tuple[tuple[tuple[str, str], Kind], ...] = (
        (of, "smooth"),
        (of, "fine"),
        (of, "varying"),
        ((of[1], of[0]), "varying"),
    )
    return [_group(names, kind, values, scaled) for names, kind in kinds]


def _group(
    of: tuple[str, ...], kind: Kind, values: Mapping[str, Array], scaled: Mapping[str, Scale]
) -> FunctionGroup:
    """Functions of one variable or of two, as a group."""
    width = functions(of, kind, {name: values[name][:1] for name in of}, scaled).shape[1]
    return FunctionGroup(of, kind, width, partial(functions, of, kind, values, scaled))


def _past(values: Array, spread: Array) -> Array:
    """What spreads of some columns (M, k), in units of its spread (k,)."""
    live = spread > _FLAT
    return np.asarray(values[:, live] / spread[live])


def functions(
    of: Sequence[str], kind: Kind, values: Mapping[str, Array], scaled: Mapping[str, Scale]
) -> Array:
    """Values (n, q) of the functions of a group.

    Args:
        of: Its variables: none, one or two.
        kind: `constant`, `polynomial`, `smooth`, `fine`, or `varying`: waves of the first one times the second.
        values: Values of the variables (n,).
        scaled: Their scales.
    """
    if kind == "constant":
        return np.ones((len(next(iter(values.values()))), 1))
    if kind == "polynomial":
        plain = [values[name] / scaled[name].size for name in of]
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
