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
from dataclasses import dataclass, fields, replace
from math import log

import numpy as np
import torch
from numpy.typing import NDArray

from nsde_torch.diagnosis.dependence import Dependence
from nsde_torch.diagnosis.evidence import stretches
from nsde_torch.diagnosis.law_terms import LawTerm, terms_of
from nsde_torch.diagnosis.regressors import BEFORE, BY_RUN, OVER_TIME, Regressors
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
_AT_ONCE = 64  # columns that are whitened together: filters need several times their memory
_FLAT = 1e-12  # of the largest square of what the physics can do: directions that some folds do not show
_SHOWN = 1e-6  # of the length of a term: less of it in some folds is rounding


@dataclass(frozen=True)
class Library:
    """Terms as columns z of the whitened residuals w: their products, beside what the physics can do already.

    The columns themselves are thousands of times as many as the data of one channel.

    Args:
        laws: A law of one term for each (P), its text.
        starts: First values of their shapes.
        gram, pull: Products of the columns with each other (P, P) and with the residuals (P,), all free of what the
            physics can do already, the columns of length 1.
        length: What the columns were divided by to be so (P,).
        parts: Sums of products over the rows of each fold (F, ...).
        tried: Number of laws before those went that the physics can do already.
    """

    laws: tuple[str, ...]
    starts: tuple[dict[str, float], ...]
    gram: Array
    pull: Array
    length: Array
    parts: _Parts
    tried: int


@dataclass(frozen=True)
class _Parts:
    """Products of columns z, residuals w and an orthonormal span of what the physics can do, fold by fold.

    Args:
        squares, pull, cross: Of each z with itself (F, P), with w (F, P) and with the span (F, P, r).
        own, of_own: Of the span with itself (F, r, r) and with w (F, r).
    """

    squares: Array
    pull: Array
    cross: Array
    own: Array
    of_own: Array


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
        if not d.of_a_variable:
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
    made = [one for term in terms for one in _made(base.regression, term, pushes)]
    for law, shapes in (beside or {}).items():
        row, _, text = law.partition(_SIZE)
        own = [push for push in pushes if push[0] == row]
        made += _made(base.regression, LawTerm(text, tuple(shapes.items())), own)
    if not made:
        return None
    whole, parts = _products(base, made)
    along, squares = parts.cross.sum(0), whole.diagonal()
    length = np.sqrt(np.maximum(squares - np.square(along).sum(1), 0.0))
    new = np.flatnonzero(np.isfinite(length) & (length > _NEW * np.sqrt(squares)) & (squares > 0))
    if not len(new):
        return None
    along, length = along[new], length[new]
    return Library(
        tuple(made[j].law for j in new.tolist()),
        tuple(made[j].start for j in new.tolist()),
        (whole[np.ix_(new, new)] - along @ along.T) / np.outer(length, length),
        (parts.pull.sum(0)[new] - along @ parts.of_own.sum(0)) / length,
        length,
        replace(parts, **{key: getattr(parts, key)[:, new] for key in ("squares", "pull", "cross")}),
        len(made),
    )


def _products(base: Base, made: Sequence[_Made]) -> tuple[Array, _Parts]:
    """Products of the columns of all laws over all rows (P, P), and those of each fold; a channel at a time."""
    r, span = base.regression, base.span.reshape(*base.regression.white.shape, -1)
    folds, of_fold = int(base.fold.max()) + 1, stretches(base.fold)
    count, own = len(made), span.shape[2]
    out = _Parts(
        *(np.zeros((folds, *shape)) for shape in ((count,), (count,), (count, own), (own, own), (own,)))
    )
    whole = np.zeros((count, count))
    for white, known, noise, c in zip(r.white, span, r.noises, r.rows, strict=True):
        moved = [j for j, one in enumerate(made) if one.change[:, c].any()]
        columns = np.empty((len(white), len(moved)), order="F")
        for at in range(0, len(moved), _AT_ONCE):
            some = [made[j].change[:, c] * made[j].value for j in moved[at : at + _AT_ONCE]]
            boxed = r.single.summed(np.stack(some, 1), r.box)
            columns[:, at : at + len(some)] = r.whitened(noise, boxed)
        whole[np.ix_(moved, moved)] += columns.T @ columns
        for f, a, b in of_fold:
            z, s, w = columns[a:b], known[a:b], white[a:b]
            out.squares[f, moved] += np.square(z).sum(0)
            out.pull[f, moved] += z.T @ w
            out.cross[f, moved] += z.T @ s
            out.own[f] += s.T @ s
            out.of_own[f] += s.T @ w
        del z, columns  # before those of the next channel are made
    return whole, out


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
            for k, name in enumerate(rows[port.value].written(port.value)):
                push = middle.new_zeros(len(middle), system.ports[port])
                push[:, k] = 1.0
                moved = system.drift(t, middle, s.u, {port: push})[:, : system.nx] - still
                change = physics.in_channels(s.dt * moved, middle).numpy()
                if np.abs(change[:, at]).max() > _MOVES * np.abs(change).max():
                    out.append((name, change))
    return out


@dataclass(frozen=True)
class _Made:
    """A law of one term on a row: what one unit of it changes is `change` (N, nx) times `value` (N,)."""

    law: str
    start: dict[str, float]
    value: Array
    change: Array


def _made(regression: Regression, term: LawTerm, pushes: Sequence[tuple[str, Array]]) -> Iterator[_Made]:
    """The laws that a term is on some rows, at their first values."""
    if not pushes:
        return
    physics, system = regression.physics, regression.vector.system
    s, middle = physics.steps, physics.middle(regression.theta)
    start = dict(term.start)
    first = system.make_effect(_law(pushes[0][0], term), {"c1": 1.0, **start}).double()
    with torch.no_grad():
        seen = seen_by(system, first, s.t + 0.5 * s.logged_dt, middle, s.u)
        value = first(s.t, middle[:, : system.nx], seen, middle[:, :0]).sum(1).numpy()
    for row, change in pushes:
        yield _Made(system.effect_key(_law(row, term)), start, value, change)


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
    gram, pull = found.gram, found.pull
    for _ in range(search.budgets.formula_terms):
        power = 0.5 * np.square(pull)
        best = int(power.argmax())
        if power[best] <= price:
            break
        for j in worth_a_fit(found.laws, power, search):
            if found.laws[j] not in search.laws:
                search.laws[found.laws[j]], new = {**found.starts[j]}, True
        along = gram[best]
        pull, gram = pull - along * pull[best], gram - np.outer(along, along)
        size = np.sqrt(np.maximum(gram.diagonal(), 0.0))
        size = np.where(size > _NEW, size, np.inf)
        pull, gram = pull / size, gram / np.outer(size, size)
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
    labels = np.unique(base.fold)
    mine = [j for j, name in enumerate(found.laws) if name == law]
    again = 0
    for _ in range(search.decisions.law_halves):
        power = _power(found, rng.choice(labels, max(len(labels) // 2, 1), replace=False))
        again += max(power[mine]) > power.max() - search.decisions.alike_nats
    return again / search.decisions.law_halves


def _power(found: Library, half: NDArray[np.int64]) -> Array:
    """Nats that each term brings to some folds, free of what the physics can do there."""
    squares, pull, cross, own, of_own = (getattr(found.parts, f.name)[half].sum(0) for f in fields(_Parts))
    theirs = cross @ np.linalg.pinv(own, rcond=_FLAT, hermitian=True)
    size = np.sqrt(np.maximum(squares - (theirs * cross).sum(1), 0.0))
    live = size > _SHOWN * found.length
    return np.asarray(0.5 * np.square((pull - theirs @ of_own) / np.where(live, size, np.inf)))
