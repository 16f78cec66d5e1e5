"""Parameters of the smallest errors of one-step predictions, where rates are inferred from positions.

    sum over positions c of  sum_k e_ck(theta)^2 / s_c^2  ->  min,     s_c^2 the mean square of e_c

(prediction error method: Ljung, System Identification, 1999, chapter 7), e the errors of a state observer with the
physics in it (`observer`). The weak form fits physics at inferred rates, which hang on the physics and lack something
of the true ones: its values are a few standard errors off on joints. The errors of the observer are what is measured
less what was foretold, whatever it makes of the rates, and nearly white. The weak form chooses and tests; this fits
once more from where it ended. Steps are those of Gauss and Newton, slopes are differences, intervals are the jackknife
over blocks of time (`spread`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data import Run
from nsde_torch.data.tracking import AlphaBeta
from nsde_torch.sysid.observer import Observer
from nsde_torch.sysid.result import Identification
from nsde_torch.sysid.spread import Spread, spread
from nsde_torch.sysid.steps import inferred_columns
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

_TURNS = 10
_SETTLED = 0.1  # standard errors that parameters may still move by
_SMALLEST = 0.05  # share of a step that is tried
_DIFFERENCE = 1e-4  # of a parameter's scale
_AT_BOUND = 1e-6  # of a parameter's scale
_PIECE_S = 0.5  # short pieces side by side are fast
_BLOCK_S = 2.0  # of the jackknife


def by_prediction_errors(
    found: Identification, system: System, runs: Sequence[Run], clock: float = 1.0
) -> Identification:
    """An identification from positions, its values and intervals by the errors of predictions.

    Args:
        found: By the weak form.
        system: The machine; it is not changed.
        runs: Recordings, all on one step.
        clock: Physical seconds per logged second.

    Returns:
        `found` with values and intervals of all that it shows and that stands at no bound; `found` itself where no rate
        is inferred, or where the fit does not settle.
    """
    columns = inferred_columns(system, runs) if runs else {}
    if not columns or not found.believed:
        return found
    dt = runs[0].dt * clock
    fit = _Fit(found.vector, Observer(system, runs, columns=list(columns), dt=dt, piece_s=_PIECE_S), dt)
    theta = found.values.copy()
    for _ in range(_TURNS):
        step = fit.step(theta, np.flatnonzero(found.shown.known))
        if step is None:
            return found
        there = fit.after(theta, step)
        if (np.abs(step.change) <= _SETTLED * np.sqrt(np.diag(step.sure.covariance))).all():
            return _with(found, there, step)
        if (there == theta).all():
            return found
        theta = there
    return found


@dataclass(frozen=True)
class _Step:
    """A step of Gauss and Newton.

    Args:
        free: Numbers of the parameters that move (f,).
        change: By how much (f,).
        sure: Covariance of these.
        chosen: Gains of the observer, by rate.
        weights: Of the errors, by rate (m,).
    """

    free: Labels
    change: Array
    sure: Spread
    chosen: list[AlphaBeta]
    weights: Array


class _Fit:
    """The sum of squares and its steps."""

    def __init__(self, vector: ParameterVector, observer: Observer, dt: float) -> None:
        self._vector, self._observer = vector, observer
        length = max(1, round(_BLOCK_S / dt))
        names = np.array([(n, first // length) for n, first, _, _ in observer.pieces])
        _, block = np.unique(names, axis=0, return_inverse=True)
        self._blocks = np.broadcast_to(block.reshape(-1), observer.judged.shape)[observer.judged]

    def step(self, theta: Array, free: Labels) -> _Step | None:
        """The step from theta, of parameters that do not leave their bounds; None where there is none."""
        v = self._vector
        v.write(self._observer.system, theta)
        chosen, square, _ = self._observer.best()
        if not (np.isfinite(square) & (square > 0)).all():
            return None
        weights = square**-0.5
        errors = self._errors(theta, chosen)
        left, slopes = errors * weights, np.zeros((*errors.shape, len(free)))
        for k, j in enumerate(free):
            aside = (
                _DIFFERENCE * v.scale[j] * (1.0 if theta[j] + _DIFFERENCE * v.scale[j] <= v.high[j] else -1.0)
            )
            there = theta.copy()
            there[j] += aside
            slopes[..., k] = (self._errors(there, chosen) - errors) * weights / aside
        while len(free):
            scaled = slopes * v.scale[free]
            change = np.linalg.lstsq(scaled.reshape(-1, len(free)), -left.reshape(-1), rcond=1e-10)[0]
            change = change * v.scale[free]
            margin = _AT_BOUND * v.scale[free]
            out = (theta[free] <= v.low[free] + margin) & (change < 0)
            out |= (theta[free] >= v.high[free] - margin) & (change > 0)
            if not out.any():
                # residuals are measured less foretold, and slopes those of what is foretold
                sure = spread(-np.moveaxis(scaled, 1, 0), left.T, self._blocks, 0)
                return _Step(free, change, _unscaled(sure, v.scale[free]), chosen, weights)
            free, slopes = free[~out], slopes[..., ~out]
        return None

    def after(self, theta: Array, step: _Step) -> Array:
        """Theta after the largest share of a step that lowers the sum of squares; theta itself where none does."""
        now = self._size(theta, step)
        share = 1.0
        while share > _SMALLEST:
            there = theta.copy()
            there[step.free] += share * step.change
            there = self._vector.inside(there)
            if self._size(there, step) <= now:
                return there
            share *= 0.5
        return theta

    def _size(self, theta: Array, step: _Step) -> float:
        return float(np.square(self._errors(theta, step.chosen) * step.weights).sum())

    def _errors(self, theta: Array, chosen: Sequence[AlphaBeta]) -> Array:
        """Errors of the rows that judge (N, m)."""
        self._vector.write(self._observer.system, theta)
        return self._observer.follow([chosen])[1][0][self._observer.judged]


def _unscaled(sure: Spread, scale: Array) -> Spread:
    """A spread of scaled parameters, as that of the parameters."""
    both = np.outer(scale, scale)
    return Spread(sure.covariance * both, sure.parts * scale, sure.weights * both)


def _with(found: Identification, theta: Array, step: _Step) -> Identification:
    """The identification with values, and the covariance of those that moved."""
    covariance, degrees = found.covariance.copy(), found.degrees.copy()
    covariance[step.free], covariance[:, step.free] = 0.0, 0.0
    covariance[np.ix_(step.free, step.free)] = step.sure.covariance
    degrees[step.free] = step.sure.degrees(np.eye(len(step.free)))
    return replace(found, values=theta, covariance=covariance, degrees=degrees)
