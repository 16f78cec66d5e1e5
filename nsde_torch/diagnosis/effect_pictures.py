"""One picture of each effect that matters: what is left over in one channel with it, and with its own term added back.

    without = residual(theta) + (term of the effect at theta)        all other parameters as they were fitted

(partial residuals; Larsen and McCleary, Technometrics 14, 1972), against the variable of which the term is most nearly
a function. A term that is a function of no single one, as a lag's, is shown as a course of a few seconds in the run in
which it is largest.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nsde_torch.diagnosis.buys import Bought, Told
from nsde_torch.diagnosis.fitted import moved_channels
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.shape import called
from nsde_torch.diagnosis.views import Rates, bins, is_plain, rates
from nsde_torch.effects import effect_class
from nsde_torch.plots.diagnosis import Cloud, Panel
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems.parameters import own_name

Array = NDArray[np.float64]

WITHOUT, WITH = "without it", "with it"
_FUNCTION = 0.5  # of a term's variance, which bins of a variable must hold to be its axis
_CONSTANT = 1e-6  # of a term's squared mean: variance below which it is a constant
_BINS = 20  # of a variable
_COURSE_S = 3.0  # length of a course


def effect_panels(
    outcome: Outcome, told: Told, buys: Mapping[str, Bought], runs: tuple[str, ...]
) -> dict[str, Panel]:
    """By effect that matters: its picture; none of one that moves nothing that can be drawn.

    Args:
        outcome: What was concluded.
        told: The effects that matter.
        buys: What effects buy: in which channel most.
        runs: Names of the runs.
    """
    regression = outcome.final.regression
    seen = rates(regression, outcome.variables)
    out: dict[str, Panel] = {}
    for name in told.few:
        channel = buys[name].channel if name in buys else ""
        channel = channel or next(iter(moved_channels(regression, name)), "")
        if channel not in seen.names or not len(seen.residual):
            continue
        number = seen.names.index(channel)
        bare = rates(_without_term(regression, name), outcome.variables)
        if not np.isfinite(bare.residual[:, number]).all():
            continue
        out[name] = _panel(seen, bare.residual[:, number], number, runs)
    return out


def _without_term(regression: Regression, effect: str) -> Regression:
    """The same residuals with the term of an effect added back; nothing is fitted again."""
    cls, theta = effect_class(effect), regression.theta.copy()
    labels = regression.vector.labels
    for j in regression.vector.of(effect):
        theta[j] = cls.null.get(own_name(labels[j]), theta[j])
    out = copy.copy(regression)
    bare = regression.physics.residual(regression.vector.inside(theta))
    out.residual = regression.single.summed(bare, regression.box)
    regression.physics.residual(regression.theta)  # its values are those of the last use
    return out


def _panel(seen: Rates, without: Array, number: int, runs: tuple[str, ...]) -> Panel:
    """The picture of one effect in one channel."""
    left = seen.residual[:, number]
    term = without - left
    plain = {name: x for name, x in seen.values.items() if is_plain(name) and name != "time"}
    held = {name: _held(x, term) for name, x in plain.items()}
    variable = max(held, key=lambda n: held[n], default="")
    parts = {WITHOUT: without, WITH: left}
    if variable and held[variable] > _FUNCTION:
        clouds = {key: _cloud(plain[variable], y, seen.block) for key, y in parts.items()}
        unit, note = seen.value_units.get(variable, ""), ""
    else:
        run, rows = _largest(seen, term)
        t = seen.values["time"][rows]
        clouds = {key: Cloud(t, y[rows], t, y[rows], np.zeros(len(t))) for key, y in parts.items()}
        variable, unit, note = "time", "s", called(runs[run])
    return replace(Panel(seen.names[number], seen.units[number], variable, unit, clouds), note=note)


def _cloud(x: Array, y: Array, block: NDArray[np.int64]) -> Cloud:
    b = bins(x, y, block)
    return Cloud(x, y, b.centre, b.mean, b.error)


def _held(x: Array, term: Array) -> float:
    """Share of a term's variance that means in bins of a variable hold; a constant is a function of anything."""
    whole = float(term.var())
    if whole <= _CONSTANT * float(term.mean()) ** 2:
        return 1.0
    if not np.ptp(x) > 0:
        return 0.0
    edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, _BINS + 1)[1:-1]))
    place = np.searchsorted(edges, x)
    count = np.maximum(np.bincount(place), 1)
    mean = np.bincount(place, weights=term) / count
    return float(((mean - term.mean()) ** 2 * count).sum() / len(term)) / whole


def _largest(seen: Rates, term: Array) -> tuple[int, NDArray[np.int64]]:
    """Number of a run, and the rows of the few seconds of it in which a term is largest."""
    power = {int(run): float(np.square(term[seen.run == run]).mean()) for run in np.unique(seen.run)}
    run = max(power, key=lambda r: power[r])
    rows = np.flatnonzero(seen.run == run)
    t = seen.values["time"][rows]
    places = np.floor((t - t[0]) / _COURSE_S).astype(np.int64)
    of_place = np.bincount(places, weights=np.square(term[rows]))
    rows = rows[places == int(of_place.argmax())]
    return run, rows[np.argsort(seen.values["time"][rows])]
