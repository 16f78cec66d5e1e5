"""Shapes that are narrower than a search looks for, such as the width at which a friction is developed.

A search keeps widths within a few times the sizes of the data (`ParameterVector.limit`), because far below them nothing
changes any more and it would not find back. The truth may be narrower: where a coordinate mostly runs fast, a friction
turns within a hundredth of its usual speed. A fit that ends at such a bound is bent in whatever the width trades with
(a friction at speed by 0.1 to 0.5 %, one near rest by 10 %), and by more than its interval. From there the way is
found: the bound is moved, and the fit goes on while that leads anywhere.
"""

import copy

import numpy as np

from nsde_torch.sysid.regression import Regression

MOVED = 0.5
"""Standard errors by which the fit must go on; what goes nearly nowhere says that narrower ones are all alike."""
_SHARE = 4.0  # by which a bound is moved at a time
_TIMES = 4  # then a width is a ten-thousandth of the usual speed, and nothing that is measured depends on it
_AT_BOUND = 1e-3  # of a parameter's scale


def narrower(regression: Regression, iterations: int) -> Regression:
    """The regression, or one that went on beyond lower bounds of shapes that only the search has."""
    v = regression.vector
    for _ in range(_TIMES):
        ends = np.flatnonzero(v.raised & (regression.theta <= v.low + _AT_BOUND * v.scale))
        if not ends.size:
            break
        bounds = v.low.copy()
        v.low[ends] /= _SHARE
        other = copy.copy(regression)
        other.run(iterations)
        if _errors_between(regression, other) < MOVED:
            v.low = bounds
            break
        regression = other
    return regression


def _errors_between(one: Regression, other: Regression) -> float:
    """Standard errors that lie between two fits of the same physics."""
    slopes = 0.5 * (one.slopes + other.slopes)
    return float(np.linalg.norm(slopes @ (other.theta - one.theta)))
