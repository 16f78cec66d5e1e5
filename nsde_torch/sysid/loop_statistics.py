"""The statistics of the test of feedback: answers, knowledge, what inputs were made from (see `loop_test`)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from nsde_torch.sysid import signals
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.series import Series
from nsde_torch.sysid.signals import Direction

Array = NDArray[np.float64]

ALPHA = 0.01
"""Chance of a finding where there is none, for each of the tests."""
_ANSWER_S, _ANSWERS = 0.2, 20  # how long after a disturbance an answer is looked for [s], [rows]
_BINS = (1, 2, 3, 5, 9, 14, 21)  # rows between which it is summed up: an answer to what lasts is smooth
_KNOWN_S, _KNOWN = 0.08, 8  # how long before a disturbance an input may have known of it
_OWN = 10  # order of the inputs' own past
_STATES_BEFORE = (1, 2, 3, 5)  # rows whose states a controller may have made an input from
_MADE = 0.02  # share of what is new in an input that past states foretell, from which it was made from states
_FOREKNOWN = 1e-6  # share of an input that is new: below, it is known beforehand and answers nothing
_UPPER = 1.645  # standard deviations of the upper limit of a share
_MOST_OF_IT = 0.8  # share of an answer by whose time it is told


@dataclass(frozen=True)
class Answer:
    """How inputs of one direction answer, or foretell, one channel."""

    input: str  # name of the direction
    channel: str
    share: float  # of the variance of what is new in the input (an answer) or in the channel (knowledge)
    chance: float  # p value, adjusted for the number of tests (Holm)
    within_s: float = 0.0  # time by which most of it has come [s]; 0 where that means nothing
    upper: float = 0.0  # upper 95 % limit of `share`


def own_innovations(values: Array, among: Array, series: Series) -> Array:
    """What columns (N, n) hold that the past of `among` (N, m) does not foretell, zero near starts."""
    live, past = signals.late(series, _OWN), _past(among, series)
    out = np.zeros_like(values)
    out[live] = signals.without(values[live], past)
    return out


def _past(among: Array, series: Series) -> Array:
    """Orthonormal columns of the past of `among` (N, m) and a constant, of the rows that have one."""
    past = signals.lagged(among, series, range(1, _OWN + 1))
    return signals.basis_of(np.column_stack((past, np.ones(len(past))))[signals.late(series, _OWN)])


def _states(regression: Regression) -> Array:
    """Logged states in whitened rows (N, nx), each of variance one."""
    x = np.asarray(regression.physics.steps.seen0)[_first_of_box(regression)]
    return signals.spread_out(regression, (x - x.mean(0)) / np.maximum(x.std(0), 1e-12))


def answers_of(
    regression: Regression, ways: Sequence[Direction], driven: Array, among: Array, series: Series
) -> tuple[tuple[Answer, ...], float]:
    """Every answer, and the chance of all own ones together."""
    new = own_innovations(driven, among, series)
    rows = max(1, min(_ANSWERS, round(_ANSWER_S / regression.dt)))
    live = signals.late(series, max(rows, _OWN))
    nothing = np.zeros((int(live.sum()), 0))
    found, own = [], []
    for j, way in enumerate(ways):
        known = signals.foreknown(new[live, j], driven[live, j], _FOREKNOWN)
        for i, channel in enumerate(regression.rows):
            columns = signals.lagged(regression.white[i][:, None], series, range(1, rows + 1))[live]
            score = signals.score_test(new[live, j], signals.binned(columns, _BINS), nothing)
            chance, share = (1.0, 0.0) if known else score
            found.append(
                (way.name, regression.physics.names[channel], share, chance, _within(new[live, j], columns))
            )
            own += [chance] if channel in way.channels else []
    statistic = -2.0 * float(np.log(np.maximum(own, 1e-300)).sum())
    return _judged(found, regression.dt), float(chi2.sf(statistic, 2 * len(own))) if own else 1.0


def made_from_states(
    regression: Regression, ways: Sequence[Direction], driven: Array, among: Array, series: Series
) -> tuple[str, ...]:
    """Names of directions that past states foretell beyond the past of the inputs (Granger, Econometrica 37 (1969))."""
    live, past = signals.late(series, _OWN), _past(among, series)
    new = signals.without(driven[live], past)
    columns = signals.lagged(_states(regression), series, _STATES_BEFORE)[live]
    found = []
    for j in range(len(ways)):
        known = signals.foreknown(new[:, j], driven[live, j], _FOREKNOWN)
        found.append((1.0, 0.0) if known else signals.score_test(new[:, j], columns, past))
    chances = signals.holm([chance for chance, _ in found])
    return tuple(
        way.name
        for way, chance, (_, share) in zip(ways, chances, found, strict=True)
        if chance < ALPHA and share >= _MADE
    )


def _within(new: Array, columns: Array) -> int:
    """Rows by which most of an answer has come."""
    size = np.square(columns.T @ new) / np.maximum(np.square(columns).sum(0), 1e-300)
    return int(np.searchsorted(np.cumsum(size), _MOST_OF_IT * size.sum())) + 1


def knowledge_of(
    regression: Regression, ways: Sequence[Direction], driven: Array, known: Sequence[int], series: Series
) -> tuple[Answer, ...]:
    """What inputs at and before a step foretell of the innovations of each channel that they drive."""
    rows = max(2, min(_KNOWN, round(_KNOWN_S / regression.dt)))
    live = signals.late(series, rows + 1)
    found = []
    for j, way in enumerate(ways):
        columns = signals.lagged(driven[:, [j]], series, range(rows + 1))[live]
        for channel in way.channels:
            i = known.index(channel)
            fitted = signals.basis_of(regression.fitted_columns(i)[live])
            chance, share = signals.score_test(regression.white[i][live], columns, fitted)
            found.append((way.name, regression.physics.names[channel], share, chance, 0))
    n, count = max(int(live.sum()), 1), rows + 1
    return tuple(
        replace(a, upper=min(1.0, a.share + _UPPER * float(np.sqrt(2 * count + 4 * n * a.share)) / n))
        for a in _judged(found, regression.dt)
    )


def _first_of_box(regression: Regression) -> NDArray[np.int64]:
    """Row of the steps at which each box begins."""
    parts = [a + np.arange((b - a) // regression.box) * regression.box for a, b in regression.single.edges]
    return np.concatenate(parts)


def new_shares(
    regression: Regression, ways: Sequence[Direction], driven: Array, series: Series
) -> dict[str, float]:
    """Share of each direction's variance that a quadratic function of the logged state does not give."""
    system = regression.physics.vector.system
    x, live = _states(regression), signals.late(series, 1)
    columns = [np.ones((len(series), 1)), x]
    pairs = system.nx * (system.nx + 1) // 2
    if 20 * pairs < len(series):
        columns.append(np.stack([x[:, i] * x[:, k] for i in range(system.nx) for k in range(i + 1)], 1))
    basis = signals.basis_of(np.concatenate(columns, 1)[live])
    values = driven[live] - driven[live].mean(0)
    left = np.square(signals.without(values, basis)).sum(0)
    return {
        way.name: float(a / b) if b > 0 else 0.0
        for way, a, b in zip(ways, left, np.square(values).sum(0), strict=True)
    }


def _judged(found: Sequence[tuple[str, str, float, float, int]], dt: float) -> tuple[Answer, ...]:
    chances = signals.holm([chance for *_, chance, _ in found])
    rows = zip(found, chances, strict=True)
    return tuple(Answer(a, b, share, chance, dt * within) for (a, b, share, _, within), chance in rows)
