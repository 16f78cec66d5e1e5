"""Residuals of steps and their slopes in units of the noise, for experiments that no regression was made of.

The noise is that of a fit of the runs there are: the laws of its channels, and what the past of the residuals foretells
beyond them (`sysid.feedback`), with the coefficients that it had there.
"""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from nsde_torch.sysid.feedback import faded, foretelling
from nsde_torch.sysid.noise import extended
from nsde_torch.sysid.physics import Physics
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.series import Series

Array = NDArray[np.float64]


@final
class NoiseUnits:
    """Puts residuals of steps into units of the noise of a fit.

    Args:
        fit: Fitted, with all channels in its past (`Regression.channels`).
    """

    def __init__(self, fit: Regression) -> None:
        self._fit = fit
        here = fit.single.summed(fit.known_before(fit.physics, fit.physics.residual(fit.theta)), fit.box)
        own = self._by_laws(fit.residual[:, fit.rows], fit.series)
        self._known = here.shape[1]
        self._b = foretelling(here, fit.series, own, channels=True)

    def residual(self, physics: Physics, residual: Array) -> Array:
        """Whitened residuals (channels, M) of experiments.

        Args:
            physics: Of their steps.
            residual: Over each step (N, nx).
        """
        fit, single = self._fit, Series(physics.steps.segments)
        known = single.summed(fit.known_before(physics, residual), fit.box)
        series = single.boxes(fit.box)
        values = single.summed(residual, fit.box)[:, fit.rows]
        return self._whitened(known[..., None], values[..., None], series)[..., 0]

    def slopes(self, physics: Physics, theta: Array) -> Array:
        """Whitened slopes (channels, M, k) of experiments at parameters (k,)."""
        fit, single = self._fit, Series(physics.steps.segments)
        values = single.summed(physics.slopes(theta), fit.box)[:, fit.rows]
        # no parameter moves a kinematic residual
        known = np.zeros((len(values), self._known, values.shape[2]))
        known[:, self._known - len(fit.rows) :] = values
        return self._whitened(known, values, single.boxes(fit.box))

    def experiments(self, physics: Physics) -> tuple[tuple[int, int], ...]:
        """First row and the one behind the last of each experiment."""
        return extended(Series(physics.steps.segments).boxes(self._fit.box)).edges

    def _whitened(self, known: Array, values: Array, series: Series) -> Array:
        """Columns (N, channels, k), with what is known of each beside it (N, m, k), in whitened rows."""
        white = self._by_laws(values, series)
        if not len(self._b):
            return white
        n, m, k = known.shape
        fades = faded(known.reshape(n, m * k), series, channels=True)
        columns = np.moveaxis(fades.reshape(len(fades), -1, m, k), 3, 1).reshape(len(fades) * k, -1)
        foretold = (columns @ self._b).reshape(len(fades), k, -1)
        return white - np.moveaxis(foretold, 2, 0)

    def _by_laws(self, values: Array, series: Series) -> Array:
        """Columns (N, channels, ...) whitened by the laws alone (channels, M, ...)."""
        laws = enumerate(self._fit.noises)
        flat = values.reshape(len(values), values.shape[1], -1)
        out = np.stack([law.whiten(flat[:, i], series) for i, law in laws])
        return out.reshape(*out.shape[:2], *values.shape[2:])
