"""Laws that no catalogue has: candidates made of terms of the variables that the residual still depends on.

Every term of the library (`law_terms`) on every row of a port that moves a channel with structure left is one
candidate, `force = c1 q q_dot`. What a term of size 1 would change in each step is worked out through the machine's
own equations, whitened and freed of what the physics can do already, as in the screening of effects. Forward orthogonal
least squares (Billings, Nonlinear System Identification, 2013) says which few are worth a fit; those join the catalogue
and are fitted, judged, exchanged and dropped as any effect is, with p values corrected for the size of the library.

A law has to be chosen again: of halves of the runs (of blocks of stretches, where there are too few runs), drawn at
random, it explains a large share about as well as the best term of the library does there (stability selection,
Meinshausen and Buehlmann, Journal of the Royal Statistical Society B 72, 2010, with likelihoods in place of a path).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import log

import numpy as np
import torch
from numpy.typing import NDArray

from nsde_torch.diagnosis.dependence import Dependence
from nsde_torch.diagnosis.law_terms import LawTerm, terms_of
from nsde_torch.diagnosis.regressors import BEFORE, BY_RUN, OVER_TIME, Regressors
from nsde_torch.diagnosis.screening import whitened_slopes
from nsde_torch.diagnosis.search import Base, Search
from nsde_torch.diagnosis.shape import product_of
from nsde_torch.diagnosis.views import variable_units
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System
from nsde_torch.systems.vocabulary import seen_by, vocabulary

Array = NDArray[np.float64]

_NEW = 0.03  # of the length of a term: less of it is nothing that the parameters cannot do already
_SIZE = " = c1 "
_MOVES = 1e-9  # of the largest push: rows of a port that do not move a channel


@dataclass(frozen=True)
class Library:
    """Terms as columns of the whitened residuals.

    Args:
        laws: A law of one term for each, its text.
        starts: First values of their shapes.
        columns: What one unit of each changes (rows, P), free of what the physics can do already, of length 1.
        residual: The whitened residuals, freed alike (rows,).
        span: What was taken out, orthonormal (rows, r).
        fold: Fold of each row.
        tried: Number of laws before those went that the physics can do already.
    """

    laws: tuple[str, ...]
    starts: tuple[dict[str, float], ...]
    columns: Array
    residual: Array
    span: Array
    fold: NDArray[np.int64]
    tried: int


def wanted_variables(
    regression: Regression, left: Sequence[Dependence], tests: Sequence[Dependence], variables: Regressors
) -> list[str]:
    """Variables that a law may be one of: those of what is left, the surest first, then those of all tests.

    A variable counts by whatever is tested of it: itself, its products, and it over time or by run, as what grows with
    a second variable looks like a drift where that one grows. Of a coordinate that something left hangs on, place and
    speed both count: a friction that grows with the square of the place is odd in the speed, and shows nothing of the
    place.

    Args:
        regression: Of the tests.
        left: Tests that are left beyond chance.
        tests: All tests.
        variables: What was tested.
    """
    most, channels = variables.budgets.law_variables, {d.channel for d in left}
    sure = _told_by(regression, left, variables)[:most]
    others = _told_by(regression, [d for d in tests if d.channel in channels], variables)
    told = list(dict.fromkeys((*sure, *others)))[:most]
    beside = with_coordinates(regression.vector.system, sure, variables)
    return list(dict.fromkeys((*told, *beside)))


def _told_by(regression: Regression, tests: Sequence[Dependence], variables: Regressors) -> list[str]:
    """Variables of some tests, the surest first."""
    names = [regression.physics.names[c] for c in regression.rows]
    out: list[str] = []
    for d in sorted(tests, key=lambda d: -d.excess):
        if not d.everywhere or d.moment is not None or d.variable in ("time", "run"):
            continue
        plain = plain_name(d.variable)
        pair = product_of(regression, names.index(d.channel), plain, variables)
        out += [v for v in pair.split(" * ") if v in variables.columns and v not in out]
    return out


def plain_name(variable: str) -> str:
    """The variable of which something is tested: without "over time", "by run" or "before"."""
    for end in (OVER_TIME, BY_RUN, BEFORE):
        variable = variable.removesuffix(end)
    return variable


def with_coordinates(system: System, names: Sequence[str], variables: Regressors) -> list[str]:
    """Some variables, then places of the speeds and speeds of the places among them, as far as they were measured."""
    beside = [v for v in _beside(system, names) if v in variables.columns]
    return list(dict.fromkeys((*names, *beside)))


def _beside(system: System, names: Sequence[str]) -> list[str]:
    """Places of the speeds and speeds of the places among some variables, in their order."""
    states, other = system.state_names, dict[str, str]()
    for at in system.bound_coordinates():
        if at.position is not None:
            place, speed = states[at.position], states[at.velocity]
            other |= {place: speed, speed: place}
    return [other[name] for name in names if name in other]


def library(
    search: Search,
    base: Base,
    channels: Sequence[str],
    wanted: Sequence[str],
    variables: Regressors,
    *,
    beside: Mapping[str, Mapping[str, float]] | None = None,
    port: str = "",
) -> Library | None:
    """The library of some variables beside physics; None where there is nothing to try.

    Args:
        search: Data and settings.
        base: The physics.
        channels: Those with structure left.
        wanted: The variables.
        variables: Values of them.
        beside: Laws of one term that are in it too, with values of their shapes.
        port: The port whose rows are tried alone; empty tries those of all.
    """
    system = base.regression.vector.system
    known = [*(name for name, _, _ in vocabulary(type(system)).variables), *system.exogenous]
    there = sorted((v for v in wanted if v in known), key=known.index)  # a product has one spelling
    in_law = {v: f"logged({v})" if v in system.exogenous else v for v in there}
    units = variable_units(system)
    terms = terms_of(
        list(in_law.values()),
        {text: variables.columns[v] for v, text in in_law.items()},
        [text for v, text in in_law.items() if units.get(v) == "rad"],
    )
    pushes = [push for push in pushes_of(base, channels) if push[0].partition("[")[0] == port or not port]
    made = [one for term in terms for one in _slopes(base.regression, term, pushes)]
    for law, shapes in (beside or {}).items():
        row, _, text = law.partition(_SIZE)
        own = [push for push in pushes if push[0] == row]
        made += _slopes(base.regression, LawTerm(text, tuple(shapes.items())), own)
    if not made:
        return None
    whole = np.concatenate(
        [whitened_slopes(search, base.regression, slope[:, :, None]) for _, _, slope in made], 1
    )
    residual, span = base.regression.white.reshape(-1), base.span
    columns = whole - span @ (span.T @ whole)
    length, size = np.linalg.norm(columns, axis=0), np.linalg.norm(whole, axis=0)
    new = np.isfinite(length) & (length > _NEW * size) & (size > 0)
    if not new.any():
        return None
    return Library(
        tuple(law for (law, _, _), is_new in zip(made, new, strict=True) if is_new),
        tuple(start for (_, start, _), is_new in zip(made, new, strict=True) if is_new),
        columns[:, new] / length[new],
        residual - span @ (span.T @ residual),
        span,
        np.tile(base.fold, len(base.regression.rows)),
        len(made),
    )


def pushes_of(base: Base, channels: Sequence[str]) -> list[tuple[str, Array]]:
    """What a push of 1 on each row of a port does to a step (N, nx), of rows that move one of some channels."""
    regression = base.regression
    physics, system = regression.physics, regression.vector.system
    s, middle = physics.steps, physics.middle(regression.theta)
    t = s.t + 0.5 * s.logged_dt
    regression.vector.use(torch.as_tensor(regression.theta))
    rows = dict(vocabulary(type(system)).ports)
    at = [physics.names.index(name) for name in channels]
    out = []
    with torch.no_grad():
        still = system.drift(t, middle, s.u)[:, : system.nx]
        for port in system.residual_ports:
            for k, name in enumerate(rows[port.value].names):
                push = middle.new_zeros(len(middle), system.ports[port])
                push[:, k] = 1.0
                moved = system.drift(t, middle, s.u, {port: push})[:, : system.nx] - still
                change = physics.in_channels(s.dt * moved, middle).numpy()
                if np.abs(change[:, at]).max() > _MOVES * np.abs(change).max():
                    out.append((f"{port.value}[{name}]" if name else port.value, change))
    return out


def _slopes(
    regression: Regression, term: LawTerm, pushes: Sequence[tuple[str, Array]]
) -> Iterator[tuple[str, dict[str, float], Array]]:
    """The laws that a term is on some rows, their first values, and what one unit of each changes (N, nx)."""
    if not pushes:
        return
    physics, system = regression.physics, regression.vector.system
    s, middle = physics.steps, physics.middle(regression.theta)
    start = dict(term.start)
    first = system.make_effect(_law(pushes[0][0], term), {"c1": 1.0, **start}).double()
    with torch.no_grad():
        seen = seen_by(system, first, s.t + 0.5 * s.logged_dt, middle, s.u)
        value = first(s.t, middle[:, : system.nx], seen, middle[:, :0]).sum(1, keepdim=True).numpy()
    for row, change in pushes:
        yield system.effect_key(_law(row, term)), start, change * value


def _law(row: str, term: LawTerm) -> str:
    return f"{row}{_SIZE}{term.text}"


def propose(
    search: Search, base: Base, channels: Sequence[str], wanted: Sequence[str], variables: Regressors
) -> bool:
    """Put laws beside the catalogue that may be what is left; whether there is a new one.

    Args:
        search: Data and settings; its `laws` grow.
        base: The physics.
        channels: Those in which something is left.
        wanted: Variables of the laws.
        variables: What its residual may depend on.
    """
    found = library(search, base, channels, wanted, variables) if wanted else None
    if found is None:
        return False
    search.tried += found.tried
    search.law_variables = tuple(dict.fromkeys((*search.law_variables, *wanted)))
    search.law_channels = tuple(dict.fromkeys((*search.law_channels, *channels)))
    price = 0.5 * log(int(base.block.max()) + 1) + log(found.tried)
    new = False
    rest, columns = found.residual, found.columns
    for _ in range(search.budgets.formula_terms):
        power = 0.5 * np.square(columns.T @ rest)
        best = int(power.argmax())
        if power[best] <= price:
            break
        for j in worth_a_fit(found.laws, power, search):
            if found.laws[j] not in search.laws:
                search.laws[found.laws[j]], new = {**found.starts[j]}, True
        direction = columns[:, best].copy()
        rest = rest - direction * (direction @ rest)
        columns = columns - np.outer(direction, direction @ columns)
        size = np.linalg.norm(columns, axis=0)
        columns = columns / np.where(size > _NEW, size, np.inf)
    return new


def worth_a_fit(laws: Sequence[str], power: Array, search: Search) -> list[int]:
    """Numbers of the terms that explain most, each law once, from the best of its first values.

    Args:
        laws: Law of each term.
        power: Log-likelihood that it brings [nats].
        search: Data and settings.
    """
    out: dict[str, int] = {}
    for j in np.argsort(-power):
        if len(out) >= search.budgets.laws_fitted or power[j] < search.budgets.close_share * power.max():
            break
        out.setdefault(laws[j], int(j))
    return list(out.values())


def chosen_again(
    search: Search, base: Base, law: str, shapes: Mapping[str, float], variables: Regressors
) -> float:
    """Share of random halves of the runs in which a law is about as good as the best of the library.

    Args:
        search: Data and settings.
        base: The physics without the law.
        law: The law.
        shapes: Values of its shapes.
        variables: What its residual may depend on.
    """
    wanted = [v for v in search.law_variables if v in variables.columns]
    found = library(search, base, search.law_channels, wanted, variables, beside={law: shapes})
    if found is None or law not in found.laws:
        return 0.0
    rng = np.random.default_rng(search.decisions.law_halves)
    labels = np.unique(found.fold)
    mine = [j for j, name in enumerate(found.laws) if name == law]
    again = 0
    for _ in range(search.decisions.law_halves):
        half = np.isin(found.fold, rng.choice(labels, max(len(labels) // 2, 1), replace=False))
        power = _power(found, half)
        again += max(power[mine]) > power.max() - search.decisions.alike_nats
    return again / search.decisions.law_halves


def _power(found: Library, half: NDArray[np.bool_]) -> Array:
    """Nats that each term brings to a part of the rows, free of what the physics can do there."""
    q = np.linalg.qr(found.span[half])[0]
    columns, rest = found.columns[half], found.residual[half]
    columns = columns - q @ (q.T @ columns)
    size = np.linalg.norm(columns, axis=0)
    pull = columns.T @ (rest - q @ (q.T @ rest))
    return np.asarray(0.5 * np.square(pull / np.where(size > 1e-9, size, np.inf)))
