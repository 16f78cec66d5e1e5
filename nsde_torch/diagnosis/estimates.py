"""Parameters with their intervals, as a diagnosis prints them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from nsde_torch.diagnosis.decisions import INTERVAL_LEVEL
from nsde_torch.inference.spread import Spread
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.result import Identification
from nsde_torch.systems.parameters import ParameterVector

Array = NDArray[np.float64]

_BOUNDS: dict[tuple[bool, bool], Literal["below", "above"]] = {
    (True, False): "below",
    (False, True): "above",
}  # by whether the ends are those of the search


@dataclass(frozen=True)
class Estimate:
    """A parameter of an effect with its interval."""

    name: str  # `effect.parameter`, with an index where there are axes
    value: float  # estimate
    low: float | None
    high: float | None  # low, high: 90 % interval, inside the bounds; None where the data do not show it
    unit: str  # unit of all
    # `below` or `above` where that end alone is what the data say: the other one is the bound of the search
    bound: Literal["below", "above"] | None = None
    widened: float = 0.0
    """What its half-width is larger by than chance makes it: by what more data do not show."""


def estimates(regression: Regression, sure: Spread, name: str) -> list[Estimate]:
    """Parameters of an effect with 90 % intervals from blocks of time.

    Args:
        regression: With the effect, at its optimum.
        sure: Its covariance.
        name: Of the effect.
    """
    return estimated(regression, sure, regression.vector.of(name))


def estimated(
    regression: Regression, sure: Spread, columns: Sequence[int], doubt: Array | None = None
) -> list[Estimate]:
    """Parameters with 90 % intervals from blocks of time.

    Args:
        regression: At its optimum.
        sure: Its covariance.
        columns: Numbers of the parameters.
        doubt: What half-widths are widened by (k,), nan for anything; None for nothing.
    """
    v, basis = regression.vector, regression.shown.basis
    error = np.sqrt(np.clip(np.diag(basis @ sure.covariance @ basis.T), 0.0, None))
    half = stdtrit(sure.degrees(basis).clip(1.0), 0.5 * (1 + INTERVAL_LEVEL)) * error
    half = np.where(regression.shown.known, half if doubt is None else half + doubt, np.nan)
    return [_inside(v, j, float(regression.theta[j]), float(half[j]), _widened(doubt, j)) for j in columns]


def of_identification(found: Identification, labels: Sequence[str]) -> list[Estimate]:
    """Estimates with 90 % intervals of an identification.

    Args:
        found: The identification.
        labels: Names of the parameters.
    """
    v, half = found.vector, found.half_widths(INTERVAL_LEVEL)
    columns = [v.labels.index(label) for label in labels]
    return [_inside(v, j, float(found.values[j]), float(half[j]), _widened(found.doubt, j)) for j in columns]


def _widened(doubt: Array | None, j: int) -> float:
    return 0.0 if doubt is None else float(doubt[j])


def _inside(v: ParameterVector, j: int, value: float, half: float, widened: float) -> Estimate:
    """A parameter with the interval of this half-width inside its bounds; without one where that is not finite."""
    if not np.isfinite(half):
        return Estimate(v.labels[j], value, None, None, v.units[j])
    low, high = float(max(value - half, v.low[j])), float(min(value + half, v.high[j]))
    bound = _BOUNDS.get((low <= v.low[j], high >= v.high[j]))
    return Estimate(v.labels[j], value, low, high, v.units[j], bound, widened)
