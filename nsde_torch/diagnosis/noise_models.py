"""The noise model that is left when a dependence is taken out of a residual.

An autoregression that was fitted to a residual has learned what the physics lacks: a strong smooth force passes for
noise that lasts, and a test under that model does not see it. So each group of functions is given the likelihood that
it has with a noise model of its own,

    L(Z) = max over a, b and the noise model   of   -N log std - orders,         r = J a + Z b + noise

by turns: a and b by generalised least squares under a model, the model from what they leave. With functions one turn
is enough, from the sensor's noise alone, which has learned nothing, or from the model that is there.
"""

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from nsde_torch.diagnosis.decisions import BUDGETS, DECISIONS, Budgets, Decisions
from nsde_torch.diagnosis.regressors import own_space
from nsde_torch.sysid.noise import Noise, estimate, first_guess
from nsde_torch.sysid.regression import Regression

Array = NDArray[np.float64]

_SETTLED = 0.5  # nats: turns between parameters and noise model that bring less have converged


@dataclass(frozen=True)
class FittedNoise:
    """A noise model and its likelihood."""

    noise: Noise  # the ARMA noise model that is left
    likelihood: float  # log likelihood, less one for each parameter of the noise model


@final
class _Start:
    """A noise model, slopes (N, k) and the residual (N,) in its whitened rows, and their products."""

    def __init__(self, noise: Noise, slopes: Array, white: Array) -> None:
        self.noise, self.slopes, self.white = noise, slopes, white
        self.gram, self.pull = slopes.T @ slopes, slopes.T @ white


@final
class NoiseModels:
    """ARMA noise models of one channel with something taken out.

    Args:
        regression: At its optimum.
        channel: Number of the channel among its rows.
        limit: Largest c of the channel (`Regression.carry_limits`).
        decisions: How much likelier a model must be.
        budgets: How many turns are made.

    Attributes:
        base: The noise model with nothing taken out but what the parameters can do.
        own: Orthonormal columns (N, r) of what the parameters can do to the whitened residual.
    """

    def __init__(
        self,
        regression: Regression,
        channel: int,
        limit: float,
        *,
        decisions: Decisions = DECISIONS,
        budgets: Budgets = BUDGETS,
    ) -> None:
        self._regression, self._limit = regression, limit
        self.own = own_space(regression, channel)
        self._decisions, self._budgets = decisions, budgets
        at = regression.rows[channel]
        self._times = regression.times(at)
        self._residual, self._slopes = regression.residual[:, at], regression.jacobian[:, at]
        self._there = there = regression.noises[channel]
        self.base = max(self._own(there), self._settled(there), key=lambda own: own.likelihood)
        rough = first_guess(self._residual, regression.series, limit, times=self._times)
        self._starts = [_Start(noise, *self._whitened(noise)) for noise in (rough, self.base.noise)]

    def without(self, functions: Array, whitened: Array | None = None) -> FittedNoise | None:
        """The noise model that is left without some functions; None where it is not much likelier.

        Args:
            functions: Per unit of time (M, q).
            whitened: The same in rows that the regression whitens (N, q); None works them out.
        """
        columns, best = functions * self._regression.dt, self.base
        for start in self._starts:
            own = whitened if start.noise is self._there else None
            if own is None:
                own = self._regression.whitened(start.noise, columns)
            best = max(best, self._left(start, columns, own), key=lambda found: found.likelihood)
        more = best.likelihood - self.base.likelihood
        return best if more > 0.5 * columns.shape[1] + self._decisions.noise_blind_nats else None

    def _settled(self, noise: Noise) -> FittedNoise:
        """The noise model of the residual, from a first one by turns."""
        best, nothing = FittedNoise(noise, -np.inf), self._slopes[:, :0]
        for turn in range(self._budgets.noise_turns):
            slopes, white = self._whitened(best.noise)
            start = _Start(best.noise, slopes, white)
            this = self._left(start, nothing, slopes[:, :0], thorough=turn > 0)
            if this.likelihood < best.likelihood + _SETTLED:
                break
            best = this
        return best

    def _whitened(self, noise: Noise) -> tuple[Array, Array]:
        """Slopes (N, k) and the residual (N,) in whitened rows."""
        whitened = self._regression.whitened(noise, np.column_stack((self._slopes, self._residual)))
        return whitened[:, :-1], whitened[:, -1]

    def _left(
        self, start: "_Start", columns: Array, whitened: Array, *, thorough: bool = False
    ) -> FittedNoise:
        """The noise model of what generalised least squares leave; every c is tried if it is to be thorough.

        Args:
            start: The noise model that weighs rows.
            columns: What is fitted beside the slopes (M, q).
            whitened: The same in whitened rows (N, q).
            thorough: Whether every c is tried.
        """
        cross = start.slopes.T @ whitened
        gram = np.block([[start.gram, cross], [cross.T, whitened.T @ whitened]])
        size = np.maximum(np.sqrt(np.diag(gram)), 1e-300)
        pull = np.append(start.pull, whitened.T @ start.white) / size
        weights = np.linalg.lstsq(gram / size / size[:, None], pull, rcond=1e-12)[0] / size
        count = self._slopes.shape[1]
        left = self._residual - self._slopes @ weights[:count] - columns @ weights[count:]
        r = self._regression
        among = None if thorough else sorted({0.0, start.noise.carry, self._limit})
        found = estimate(
            left,
            r.series,
            limit=self._limit,
            orders=r.orders,
            memory=r.memory,
            among=among,
            times=self._times,
        )
        return self._own(found)

    def _own(self, noise: Noise) -> FittedNoise:
        return FittedNoise(noise, noise.likelihood(len(self._regression.series)))
