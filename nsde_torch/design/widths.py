"""Members at widths of their frictions that the runs leave open.

A friction develops within a width of speed. Runs that mostly move fast say nothing of it below some bound, as far down
as it goes, and no quadratic about one optimum says so; an experiment near rest hangs on it. So a member is followed at
a few widths, each with the other parameters fitted again and weighed by how well it explains the runs: what is drawn
comes from all of them, and an experiment is fitted from each. The bound that a search keeps widths above
(`ParameterVector.limit`), which is one of the speeds of the runs, is moved down for the slower experiment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data import Run
from nsde_torch.effects import Effect
from nsde_torch.effects.law import Law
from nsde_torch.inference.posterior import LogWithPrior, Posteriors
from nsde_torch.systems.parameters import ParameterVector, own_name

Array = NDArray[np.float64]
DEEPER = 16.0
"""Times that widths may be narrower than the least that a search looks for in the runs."""
_RATIO = 3.0  # from one width to the next
_WORST = 4.0  # nats: widths that explain the runs worse by more are left out
_KNOWN = 0.25  # standard error over width below which it is known
_HELD = 0.05  # of a width, while the other parameters are fitted
_ROUNDS = 6
_STABLE = 0.9  # delay over step: Runge and Kutta's rule follows the poles of the approximation, 2.45 / delay
_FOLLOWED = 0.7  # width over what a friction changes of a speed in a step: narrower ones turn round within it


@dataclass(frozen=True)
class Branch:
    """A member near one width.

    Args:
        theta: Parameters (k,).
        known: Information about them there, that without data included (k, k).
        nats: Log-likelihood of the runs [nats].
    """

    theta: Array
    known: Array
    nats: float


@dataclass(frozen=True)
class LogOfRuns:
    """The runs there are.

    Args:
        runs: The runs.
        clock: Physical seconds per logged second.
        run_in: Whether any member remembers, so that the first rows of all only bring up memory.
    """

    runs: tuple[Run, ...]
    clock: float
    run_in: bool


def width_columns(vector: ParameterVector) -> list[int]:
    """Numbers of the parameters that are widths of dry friction."""
    dry = {str(e.name): e.relative for e in vector.system.effects if isinstance(e, Law) and e.dry}
    return [i for i, k in enumerate(vector.labels) if own_name(k) in dry.get(k.partition(".")[0], {})]


def lower_bounds(fit: ParameterVector, theta: Array, *, dt: float, fine_dt: float) -> Array:
    """Lower bounds (k,) of a filter: widths below what the search looked for, and delays that its steps follow.

    Args:
        fit: Parameters with the bounds of the search.
        theta: Their values (k,).
        dt: Step of the log [s].
        fine_dt: Step of the filter's integration [s].
    """
    sizes = {str(e.name): e.amplitudes for e in fit.system.effects if isinstance(e, Law)}
    low = fit.low.copy()
    for i in width_columns(fit):
        if fit.raised[i]:
            effect = fit.labels[i].partition(".")[0]
            dry = [j for j in fit.of(effect) if own_name(fit.labels[j]) in sizes[effect]]
            least = _FOLLOWED * dt * float(np.max(theta[dry], initial=0.0))
            low[i] = min(low[i], max(low[i] / DEEPER, least))
    return np.maximum(low, followed_delays(fit, fine_dt))


def followed_delays(vector: ParameterVector, fine_dt: float) -> Array:
    """The shortest delays (k,) that steps of the integration follow, -inf of other parameters.

    Args:
        vector: Parameters.
        fine_dt: Step of the integration [s].
    """
    low = np.full(len(vector), -np.inf)
    late = {str(e.name): e.relative for e in vector.system.effects if isinstance(e, Effect) and e.n_memory}
    for i, label in enumerate(vector.labels):
        if late.get(label.partition(".")[0], {}).get(own_name(label)) == "step":
            low[i] = _STABLE * fine_dt
    return low


def branches(own: Posteriors, log: LogOfRuns, best: Branch, prior: Array) -> tuple[Branch, ...]:
    """A member at the widths that its runs leave open, the likeliest first.

    Args:
        own: Posterior densities of the member.
        log: The runs there are.
        best: Where its fit ended.
        prior: What is known without data (k, k).
    """
    v, theta = own.vector, best.theta
    error = np.sqrt(np.diag(np.linalg.inv(best.known)))
    columns = [i for i in width_columns(v) if error[i] > _KNOWN * theta[i]]
    if not columns:
        return (best,)
    factors = [_RATIO**p for p in (-3, -2, -1, 1)]
    rows = np.tile(theta, (len(factors), 1))
    rows[:, columns] *= np.array(factors)[:, None]
    rows = np.unique(np.stack([v.inside(row) for row in rows]), axis=0)
    moved = np.abs(np.log(rows[:, columns] / theta[columns])).max(1) > 0.5 * np.log(_RATIO)
    rows = rows[moved]
    problems = []
    for row in rows:
        hold = np.zeros(len(theta))
        hold[columns] = 1.0 / np.square(_HELD * row[columns])
        problems.append(LogWithPrior(log.runs, row, prior + np.diag(hold)))
    told = own.modes(problems, rounds=_ROUNDS, run_in=log.run_in)
    out = [best]
    for row, fit in zip(rows, told, strict=True):
        freed = np.zeros(len(theta))
        freed[columns] = 1.0 / np.square(row[columns]) - 1.0 / np.square(_HELD * row[columns])
        out.append(Branch(fit.theta, fit.information + np.diag(freed), fit.nats))
    top = max(b.nats for b in out)
    return tuple(sorted((b for b in out if b.nats > top - _WORST), key=lambda b: -b.nats))
