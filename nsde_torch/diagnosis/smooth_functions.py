"""Smooth functions of one variable and of two: what a flexible model of a residual is a sum of.

    f(z) = c + sum_i f_i(z_i) + sum_{i<j} f_ij(z_i, z_j)             (functional analysis of variance; GA2M)

(Wahba and others, Annals of Statistics 23 (1995); Duvenaud, Nickisch and Rasmussen, NIPS 2011), each f a polynomial of
low degree, which goes on beyond the data, plus a Gaussian process in its reduced rank (`nsde_torch.inference.smooth`).
Beside these stand inputs as they were
before, and variables that act more or less in the course of a run.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from nsde_torch.diagnosis.regressors import BEFORE, OVER_TIME, Regressors
from nsde_torch.inference.smooth import Kind, Scale, functions

Array = NDArray[np.float64]

_FEWEST = 4  # variables up to which processes of two are tried at once
_FEW = 8  # variables beyond which products alone are
_FLAT = 1e-9  # spread below which a column says nothing


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
