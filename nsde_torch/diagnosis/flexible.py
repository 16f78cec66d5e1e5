"""What a flexible model foretells of the residuals of physics, on runs that it did not see.

Functions of one variable and of two (`smooth_functions`) of all that the machine measures, of inputs as they were
before, and of time in the run, stand on every row of every port that takes a residual; those that pay are chosen and
fitted without each group of runs in turn, and judged on it (`flexible_part`). Where a machine has so many rows and
variables that this would take long, functions stand on each channel by itself, at last of one variable each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nsde_torch.diagnosis.decisions import Budgets
from nsde_torch.diagnosis.flexible_part import Foretold, Part, Push
from nsde_torch.diagnosis.laws import pushes_of
from nsde_torch.diagnosis.regressors import Regressors
from nsde_torch.diagnosis.search import Base
from nsde_torch.diagnosis.smooth_functions import FunctionGroup, first_groups, scales
from nsde_torch.sysid.explained import bump, smooth_rate
from nsde_torch.sysid.regression import Regression

Array = NDArray[np.float64]

_MOVES = 1e-3  # of the largest change of a channel: rows of a port that move it


@dataclass(frozen=True)
class Flexible:
    """Physics alone and with a flexible model, on folds left out.

    Args:
        names: Of the channels.
        plain, flexible: Log density of each whitened row (N, channels) [nat].
        plain_squares, flexible_squares: Squared mean residual rates over the test function (K, channels).
        band_run: Number of the run of each of these means (K,).
        parts: By part: the functions, and what they foretell.
        pairs: Whether functions of two variables were among them.
    """

    names: tuple[str, ...]
    plain: Array
    flexible: Array
    plain_squares: Array
    flexible_squares: Array
    band_run: NDArray[np.int64]
    parts: tuple[tuple[Part, Foretold], ...]
    pairs: bool


def flexible(
    base: Base, variables: Regressors, budgets: Budgets, *, groups: Sequence[FunctionGroup] | None = None
) -> Flexible:
    """Fit a flexible model to what physics leaves, each fold left out in turn.

    Args:
        base: The physics at its optimum.
        variables: What its residual may depend on.
        budgets: How much is tried.
        groups: Functions to choose from on every row; None takes all of `first_groups`.
    """
    parts, pairs = _parts(base, variables, budgets, groups)
    r = base.regression
    count = len(r.rows)
    shape = (len(base.fold), count)
    densities = np.zeros(shape), np.zeros(shape)
    left = np.zeros((len(r.series), count)), np.zeros((len(r.series), count))
    done = []
    for part in parts:
        both = part.foretold()
        for found, density, rest in zip(both, densities, left, strict=True):
            for c in part.channels:
                density[:, c], rest[:, c] = found.density[c], found.left[c]
        done.append((part, both[1]))
    window = bump(r.dt)
    squares = [np.square(smooth_rate(rest, r.series.edges, window, r.dt)) for rest in left]
    fitting = [max(b - a - len(window) + 1, 0) for a, b in r.series.edges]
    run = np.repeat(np.array(r.physics.steps.runs, dtype=np.int64), fitting)
    names = tuple(r.physics.names[c] for c in r.rows)
    return Flexible(names, densities[0], densities[1], squares[0], squares[1], run, tuple(done), pairs)


def _parts(
    base: Base, variables: Regressors, budgets: Budgets, given: Sequence[FunctionGroup] | None
) -> tuple[list[Part], bool]:
    """Ports and channels that belong together, or each channel by itself where there are many."""
    scaled = scales(variables)
    together = _together(base.regression, _pushes(base))
    alone = [_alone(base.regression, c) for c in range(len(base.regression.rows))]
    for split, pairs in ((together, True), (alone, True), (alone, False)):
        groups = first_groups(variables, scaled, pairs=pairs) if given is None else list(given)
        columns = sum(g.width for g in groups)
        if max((len(p) for p, _ in split), default=0) * columns <= budgets.flexible_columns or not pairs:
            break
    parts = [Part(base, variables, scaled, groups, p, c, budgets) for p, c in split]
    return parts, pairs


def _pushes(base: Base) -> list[Push]:
    """What a push of 1 on each row of a port changes in each box, of channels that it moves."""
    r = base.regression
    names = [r.physics.names[c] for c in r.rows]
    summed = {row: r.single.summed(change, r.box)[:, r.rows] for row, change in pushes_of(base, names)}
    largest = np.max([np.abs(change).max(0) for change in summed.values()], axis=0, initial=0.0)
    out = []
    for row, change in summed.items():
        own = {
            c: change[:, c]
            for c in range(len(r.rows))
            if largest[c] > 0 and np.abs(change[:, c]).max() > _MOVES * largest[c]
        }
        if own:
            out.append(Push(row, own))
    return out


def _together(regression: Regression, pushes: Sequence[Push]) -> list[tuple[list[Push], list[int]]]:
    """Rows of ports that move the same channels, and channels that no port moves by themselves."""
    out: list[tuple[list[Push], set[int]]] = []
    for push in pushes:
        own: tuple[list[Push], set[int]] = ([push], set(push.changes))
        for other in [o for o in out if o[1] & own[1]]:
            out.remove(other)
            own = (other[0] + own[0], other[1] | own[1])
        out.append(own)
    moved = {c for _, channels in out for c in channels}
    rest = [_alone(regression, c) for c in range(len(regression.rows)) if c not in moved]
    return [(p, sorted(c)) for p, c in out] + rest


def _alone(regression: Regression, c: int) -> tuple[list[Push], list[int]]:
    """A channel by itself: a rate of 1 changes it over a box by the box's length."""
    unit = np.full(len(regression.series), regression.dt)
    return [Push(f"rate of {regression.physics.names[regression.rows[c]]}", {c: unit})], [c]
