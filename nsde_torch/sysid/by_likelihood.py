"""Values and intervals of largest likelihood (`nsde_torch.inference`), where its innovations are what they should be.

The regression gives the first values, and is an independent check: where simple fits speak against it, where states
were smoothed before they were logged, or where the innovations of the filter are not white, its own values stay.
"""

import copy
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from nsde_torch.data import Run
from nsde_torch.errors import DataError, NonFiniteError
from nsde_torch.inference import LogLikelihood, MaximumLikelihood, Optimum, maximised
from nsde_torch.inference.levels import Levels
from nsde_torch.sysid.result import Identification
from nsde_torch.systems import System

MOST = 20_000_000
"""Entries of the covariances of all rows above which the regression's values stay: half an hour of flight at 100 Hz."""


def by_likelihood(
    found: Identification,
    system: System,
    runs: Sequence[Run],
    clock: float = 1.0,
    near: tuple[System, Optimum] | None = None,
    held: Levels | None = None,
) -> Identification:
    """An identification, its values and intervals by the likelihood.

    Args:
        near: The same machine where a fit of it has ended, and the optimum there.
        held: Noise levels that are known; None finds them.

    Returns:
        `found` with `likelihood`, and its values and intervals of all that the data show and that stands at no bound,
        unless something speaks against them.
    """
    objected = found.guard is not None and found.guard.objections
    # inputs that answer the states know of noise what a smoother took out of them (`diagnosis.behind_smoothers`)
    answered = found.loop is not None and bool(found.loop.closed_loop) and any(run.band for run in runs)
    if objected or answered or entries(system, runs) > MOST:
        return found
    machine = copy.deepcopy(system)
    found.vector.write(machine, found.values)
    try:
        if near is None:
            best, at = maximised(LogLikelihood(machine, runs, clock), held=held, nuisances=held is None)
        else:
            best, at = maximised(near[1].of.of(near[0]), near[1])
    except (DataError, NonFiniteError, np.linalg.LinAlgError):
        return found
    found = replace(found, likelihood=best, optimum=at)
    return found if best.objections else _with(found, best)


def entries(system: System, runs: Sequence[Run]) -> int:
    """Entries of the covariances of all rows of some runs."""
    return sum(len(run) for run in runs) * len(system.error_names) ** 2


def _with(found: Identification, best: MaximumLikelihood) -> Identification:
    """The identification with values, and the covariance of those that are free."""
    free = best.free
    covariance, degrees = found.covariance.copy(), found.degrees.copy()
    covariance[free], covariance[:, free] = 0.0, 0.0
    covariance[np.ix_(free, free)] = best.spread.covariance
    degrees[free] = best.spread.degrees(np.eye(len(free)))
    return replace(found, values=best.theta, covariance=covariance, degrees=degrees, converged=True)
