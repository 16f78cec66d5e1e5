"""A sparse formula for what the residual still depends on: a lead, unverified.

The residual rate of a channel is regressed on a library of functions of the variables that it depends on,

    v, v^2, v^3, v^5, v |v|, |v|, sign v,   max(v - a, 0), min(v - a, 0) for zero and some a in the range of v,
    sin k v, cos k v of an angle,   sin, cos at a period that was found,   a b, a^2 b, a b^2

in the whitened weak form, free of what the declared parameters can do. Terms are chosen by forward orthogonal least
squares (Billings, Nonlinear System Identification, 2013), by pysindy's FROLS where that is installed, and kept while
each brings more log likelihood than its Schwarz price and that of having chosen it among so many.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from math import log

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgWarning

from nsde_torch.diagnosis.decisions import BUDGETS, Budgets
from nsde_torch.diagnosis.dependence import Dependence
from nsde_torch.diagnosis.regressors import Regressors, own_space
from nsde_torch.diagnosis.shape import called, period_of, product_of
from nsde_torch.diagnosis.views import is_plain, variable_units
from nsde_torch.evaluation.report import number
from nsde_torch.sysid.explained import per_second
from nsde_torch.sysid.regression import Regression

Array = NDArray[np.float64]

_NEW = 0.03  # of the length of a function: less of it is nothing that the parameters cannot do already
_KNOTS = (0.02, 0.05, 0.1, 0.2, 0.35, 0.65, 0.8, 0.9, 0.95, 0.98)  # quantiles of hinges
_SAME = 1e-3  # of the largest singular value: functions that are the same but for this
_SHARPNESS = 20.0  # of a sign, per 90 % quantile of the variable


@dataclass(frozen=True)
class Term:
    """One term of a formula.

    Args:
        function: What is multiplied, in SI units.
        coefficient: Its coefficient.
        error: Standard error of it, from blocks of time.
    """

    function: str
    coefficient: float
    error: float


@dataclass(frozen=True)
class Formula:
    """A sparse formula for the residual rate of a channel.

    Args:
        channel: Name of the channel.
        unit: Unit of its rate.
        terms: The terms, in the order in which they were chosen.
        share: Share of the whitened variance that the formula explains.
        by: What chose the terms.
        only_run: Name of the run that it is of; empty: of all.
    """

    channel: str
    unit: str
    terms: tuple[Term, ...]
    share: float
    by: str
    only_run: str = ""

    @property
    def text(self) -> str:
        """The formula on one line."""
        parts = [
            f"{'-' if t.coefficient < 0 else '+'} {number(abs(t.coefficient))} {t.function}"
            for t in self.terms
        ]
        where = f"in {self.only_run}, " if self.only_run else ""
        return f"{where}d {self.channel} / dt lacks {' '.join(parts).removeprefix('+ ')}  [{self.unit}, SI]"


def formula(
    regression: Regression, left: Sequence[Dependence], variables: Regressors, runs: Sequence[str]
) -> Formula | None:
    """A formula for the channel that depends most on something, or None where no function helps.

    Args:
        regression: With everything that was found, at its optimum.
        left: What the residual depends on beyond chance, the surest first.
        variables: What they may depend on.
        runs: Names of the runs, by number.
    """
    left = [d for d in left if d.moment is None and d.sinusoid is None]
    if not left:
        return None
    most = max(left, key=lambda d: d.excess)
    name = most.channel
    names = [regression.physics.names[c] for c in regression.rows]
    channel = names.index(name)
    if most.noise is not None:
        regression = regression.under(channel, most.noise)
    names_of, functions = library(regression, channel, [d for d in left if d.channel == name], variables)
    if not names_of:
        return None
    if most.run is not None:
        functions = functions * (regression.owners == most.run)[:, None]
    own, white = own_space(regression, channel), regression.white[channel]
    whole = regression.whitened(regression.noises[channel], functions * regression.dt)
    z, rest = (x - own @ (own.T @ x) for x in (whole, white))
    new = np.linalg.norm(z, axis=0) > _NEW * np.linalg.norm(whole, axis=0)
    if not new.any():
        return None
    names_of, z = [n for n, is_new in zip(names_of, new, strict=True) if is_new], z[:, new]
    order, by = chosen(z, rest, variables.budgets)
    of_white = regression.whitened_rows(regression.blocks)
    price = 0.5 * log(int(of_white.max()) + 1) + log(len(names_of))  # nats
    kept: list[int] = []
    reached = 0.0
    for j in order:
        this = _nats(z[:, [*kept, j]], rest)
        if this - reached > price:
            kept, reached = [*kept, j], this
    if not kept:
        return None
    coefficients, errors = _fitted(z[:, kept], rest, of_white)
    return Formula(
        name,
        per_second(regression.physics.units[regression.rows[channel]]),
        tuple(
            Term(names_of[j], float(c), float(e)) for j, c, e in zip(kept, coefficients, errors, strict=True)
        ),
        float(np.clip((2.0 * reached - len(kept)) / max(float(rest @ rest), 1e-300), 0.0, 1.0)),
        by,
        "" if most.run is None else called(runs[most.run]),
    )


def library(
    regression: Regression, channel: int, left: Sequence[Dependence], variables: Regressors
) -> tuple[list[str], Array]:
    """Names and values (M, q) of functions of the variables that a channel depends on."""
    columns = {**variables.columns, "time": variables.t}
    units = variable_units(regression.vector.system)
    wanted: list[str] = []
    for d in left:
        pair = product_of(regression, channel, d.variable, variables)
        wanted += [v for v in pair.split(" * ") if v in columns and v not in wanted]
    wanted = wanted[: variables.budgets.formula_variables]
    out: dict[str, Array] = {}
    for name in wanted:
        v, label, start = columns[name], name, 0.0
        if (
            name == "time"
        ):  # where a clock starts means nothing: the middle of the data takes the place of zero
            start = float(v.mean())
            v, label = v - start, f"({shifted(name, start)})"
        size = max(float(np.quantile(np.abs(v), 0.9)), 1e-12)
        out |= {
            label: v,
            f"{label}^2": v**2,
            f"{label}^3": v**3,
            f"{label}^5": v**5,
            f"|{label}| {label}": np.abs(v) * v,
            f"|{label}|": np.abs(v),
            f"sign{label}" if start else f"sign({label})": np.tanh(_SHARPNESS * v / size),
        }
        for a in [0.0, *np.quantile(v, _KNOTS)]:
            shown = shifted(name, start + a)
            out |= {
                f"max({shown}, 0)": np.clip(v - a, 0.0, None),
                f"min({shown}, 0)": np.clip(v - a, None, 0.0),
            }
        if units.get(name) == "rad":
            for k in (1, 2, 3):
                angle = name if k == 1 else f"{k} {name}"
                out |= {f"sin({angle})": np.sin(k * v), f"cos({angle})": np.cos(k * v)}
        period = period_of(regression, channel, name, variables) if is_plain(name) else None
        if period is not None:
            w = 2.0 * np.pi / period
            wave = w * variables.values(name)
            out |= {f"sin({w:.4g} {name})": np.sin(wave), f"cos({w:.4g} {name})": np.cos(wave)}
    for i, first in enumerate(wanted):
        for second in wanted[i + 1 :]:
            a, b = columns[first], columns[second]
            out |= {
                f"{first} {second}": a * b,
                f"{first}^2 {second}": a**2 * b,
                f"{first} {second}^2": a * b**2,
            }
    kept = {k: v for k, v in out.items() if float(v.std()) > 1e-12}
    return list(kept), np.stack(list(kept.values()), 1) if kept else np.zeros((len(variables.t), 0))


def shifted(name: str, by: float) -> str:
    """`name - by` with the sign that it has."""
    return f"{name} {'-' if by >= 0 else '+'} {abs(by):.3g}" if by else name


def chosen(z: Array, rest: Array, budgets: Budgets = BUDGETS) -> tuple[list[int], str]:
    """Columns in the order of forward orthogonal least squares, and what made the choice."""
    most, size = budgets.formula_terms, np.linalg.norm(z, axis=0)
    live = np.flatnonzero(size > 1e-9 * max(float(size.max()), 1e-300))
    unit = z[:, live] / size[live]
    try:
        from pysindy import FROLS

        model = FROLS(max_iter=most, alpha=1e-10, unbias=False)
        with warnings.catch_warnings():  # functions that are nearly the same: only their order is of use
            warnings.simplefilter("ignore", LinAlgWarning)
            model.fit(unit, rest[:, None])
    except (ImportError, ValueError):  # not installed, or it refuses functions that depend on each other
        return [int(live[j]) for j in forward(unit, rest, most)], "forward orthogonal least squares"
    order: list[int] = []
    for coefficients in model.history_:
        order += [int(j) for j in np.flatnonzero(coefficients[0]) if int(j) not in order]
    return [int(live[j]) for j in order[:most]], "pysindy FROLS"


def forward(unit: Array, rest: Array, terms: int) -> list[int]:
    """Forward orthogonal least squares: each time the column that explains most of what is left.

    Args:
        unit: Columns of length 1 (N, q).
        rest: What to explain (N,).
        terms: Most columns to choose.
    """
    left, order = unit.copy(), []
    for _ in range(min(terms, unit.shape[1])):
        size = np.linalg.norm(left, axis=0)
        size[size < 1e-4] = np.inf  # as good as chosen already
        power = np.square(left.T @ rest) / np.square(size)
        best = int(power.argmax())
        if power[best] <= 0:
            break
        order.append(best)
        direction = left[:, best] / size[best]
        left = left - np.outer(direction, direction @ left)
    return order


def _nats(z: Array, rest: Array) -> float:
    """Log-likelihood that columns bring to a whitened residual [nats]."""
    size = np.linalg.norm(z, axis=0)
    return 0.5 * float(rest @ (z / size @ np.linalg.lstsq(z / size, rest, rcond=_SAME)[0]))


def _fitted(z: Array, rest: Array, block: NDArray[np.int64]) -> tuple[Array, Array]:
    """Coefficients, and their standard errors from blocks of time."""
    inverse = np.linalg.pinv(z)
    coefficients = inverse @ rest
    left = rest - z @ coefficients
    parts = np.zeros((int(block.max()) + 1, z.shape[1]))
    np.add.at(parts, block, inverse.T * left[:, None])
    return coefficients, np.sqrt(np.square(parts).sum(0) * len(parts) / max(len(parts) - z.shape[1], 1))
