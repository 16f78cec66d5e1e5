"""Parameters of the smallest errors of one-step predictions, where rates are inferred from positions.

    sum over positions c of  sum_k e_ck(theta)^2 / s_c^2  ->  min,     s_c^2 the mean square of e_c

(prediction error method: Ljung, System Identification, 1999, chapter 7), e the errors of a state observer with the
physics in it (`observer`). The weak form fits physics at inferred rates, which hang on the physics and lack something
of the true ones: its values are a few standard errors off on joints. The errors of the observer are what is measured
less what was foretold, whatever it makes of the rates, and nearly white. The weak form chooses and tests; this fits
once more from where it ended. Steps are those of Gauss and Newton, slopes are differences, intervals are the jackknife
over blocks of time (`spread`).

Which way a joint moves that is slower than what is not known of its rate, nobody knows: physics with a dry friction is
its mean over that. Three points take most of the variance (`Observer.spread`); what lies between them is a wider
tanh(v / w), w^2 = width^2 + (pi / 2) (the rest), whose slope at rest is that of its mean. Else errors jump with the
parameters, and no step settles.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data import Run
from nsde_torch.effects.law import Law
from nsde_torch.sysid.observer import Observer
from nsde_torch.sysid.result import Identification
from nsde_torch.sysid.spread import Spread, spread
from nsde_torch.sysid.steps import inferred_columns
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector, own_name

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

_FEWEST = 0.6  # share of the rows that must be far enough from a start
_TURNS = 10
_CHOICES = 2  # turns that begin with gains of their own; then these stay
_SETTLED, _STUCK = (
    0.2,
    0.5,
)  # standard errors that parameters may still move by; where no share of a step is better
_SMALLEST = 0.05  # share of a step that is tried
_DIFFERENCE = 1e-4  # of a parameter's scale
_BETWEEN = 0.3  # share of a variance that lies between three points
_AT_BOUND = 1e-6  # of a parameter's scale
_SLOWEST_S = 0.6  # longest time constant of the observer: here the physics is what is fitted, and may count
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
        is inferred, most rows are near a start, or the fit does not settle.
    """
    columns = inferred_columns(system, runs) if runs else {}
    if not columns or not found.believed:
        return found
    dt = runs[0].dt * clock
    observer = Observer(system, runs, columns=list(columns), dt=dt, piece_s=_PIECE_S, slowest=_SLOWEST_S)
    if observer.share < _FEWEST:
        return found
    fit = _Fit(found.vector, observer, [columns[j] for j in observer.rates], dt)
    free = np.flatnonzero(found.shown.known)
    theta = found.values.copy()
    for turn in range(_TURNS):
        if turn < _CHOICES and not fit.choose(theta):
            return found
        step = fit.step(theta, free)
        if step is None:
            return found
        there = fit.after(theta, step)
        away = float(np.abs(step.change / np.sqrt(np.diag(step.sure.covariance))).max())
        stuck = bool((there == theta).all())
        if turn >= _CHOICES - 1 and away <= (_STUCK if stuck else _SETTLED):
            return _with(found, there, step)
        if stuck:
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
        size: The sum of squares before it.
    """

    free: Labels
    change: Array
    sure: Spread
    size: float


class _Fit:
    """The sum of squares and its steps.

    Args:
        vector: Parameters.
        observer: What foretells.
        unknown: What is not known of each rate (m,), before gains are chosen.
        dt: The step [s].

    Attributes:
        widths: Numbers of the widths of dry frictions, with the number of the rate that each reads.
    """

    def __init__(
        self, vector: ParameterVector, observer: Observer, unknown: Sequence[float], dt: float
    ) -> None:
        self._vector, self._observer, self._dt = vector, observer, dt
        self._unknown = np.array(unknown)
        self.widths = {
            j: observer.rates.index(e.at.velocity)
            for e in vector.system.effects
            if isinstance(e, Law) and e.dry and e.at.velocity in observer.rates
            for j in vector.of(e.name)
            if own_name(vector.labels[j]) == "width"
        }
        length = max(1, round(_BLOCK_S / dt))
        names = np.array([(n, first // length) for n, first, _, _ in observer.pieces])
        _, block = np.unique(names, axis=0, return_inverse=True)
        self._blocks = np.broadcast_to(block.reshape(-1), observer.judged.shape)[observer.judged]

    def choose(self, theta: Array) -> bool:
        """Choose gains and weights of the errors at theta; whether there are any."""
        self._use(theta)
        self._gains, square, _ = self._observer.best()
        if not (np.isfinite(square) & (square > 0)).all():
            return False
        self._weights = square**-0.5
        pairs = zip(self._gains, square.tolist(), strict=True)
        self._unknown = np.array([gain.unknown(own, self._dt) for gain, own in pairs])
        return True

    def step(self, theta: Array, free: Labels) -> _Step | None:
        """The step, of parameters that do not leave their bounds; None where none moves, or they are not told apart."""
        v = self._vector
        left = self._errors(theta)
        slopes = np.zeros((*left.shape, len(free)))
        for k, j in enumerate(free):
            aside = _DIFFERENCE * v.scale[j]
            there = theta.copy()
            there[j] += aside if theta[j] + aside <= v.high[j] else -aside
            slopes[..., k] = (self._errors(there) - left) / (there[j] - theta[j])
        while len(free):
            scaled = slopes * v.scale[free]
            change, _, rank, _ = np.linalg.lstsq(
                scaled.reshape(-1, len(free)), -left.reshape(-1), rcond=1e-10
            )
            if rank < len(free):  # predictions show some of these only together
                return None
            change = change * v.scale[free]
            margin = _AT_BOUND * v.scale[free]
            out = (theta[free] <= v.low[free] + margin) & (change < 0)
            out |= (theta[free] >= v.high[free] - margin) & (change > 0)
            if not out.any():
                # residuals are measured less foretold, and slopes those of what is foretold
                sure = spread(-np.moveaxis(slopes, 1, 0), left.T, self._blocks, 0)
                return _Step(free, change, sure, float(np.square(left).sum()))
            free, slopes = free[~out], slopes[..., ~out]
        return None

    def after(self, theta: Array, step: _Step) -> Array:
        """Theta after the largest share of a step that lowers the sum of squares; theta itself where none does."""
        share = 1.0
        while share > _SMALLEST:
            there = theta.copy()
            there[step.free] += share * step.change
            there = self._vector.inside(there)
            if np.square(self._errors(there)).sum() <= step.size:
                return there
            share *= 0.5
        return theta

    def _use(self, theta: Array) -> None:
        """Give the observer's machine its values, dry frictions as their means over what is not known."""
        there = theta.copy()
        for j, c in self.widths.items():
            self._observer.spread[c] = (1.0 - _BETWEEN) ** 0.5 * self._unknown[c]
            there[j] = np.hypot(theta[j], (0.5 * np.pi * _BETWEEN) ** 0.5 * self._unknown[c])
        self._vector.write(self._observer.system, there)

    def _errors(self, theta: Array) -> Array:
        """Errors of the rows that judge, each over their usual size (N, m)."""
        self._use(theta)
        errors = self._observer.follow([self._gains])[1][0][self._observer.judged]
        return np.asarray(errors * self._weights)


def _with(found: Identification, theta: Array, step: _Step) -> Identification:
    """The identification with values, and the covariance of those that moved."""
    covariance, degrees = found.covariance.copy(), found.degrees.copy()
    covariance[step.free], covariance[:, step.free] = 0.0, 0.0
    covariance[np.ix_(step.free, step.free)] = step.sure.covariance
    degrees[step.free] = step.sure.degrees(np.eye(len(step.free)))
    return replace(found, values=theta, covariance=covariance, degrees=degrees)
