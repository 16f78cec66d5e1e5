"""The most likely parameters by residuals of steps: Gauss and Newton's steps that never make the likelihood less.

The iterations of a regression solve its equations with the noise of the last fit; they settle where these hold, which
in gentle flights need not be near the largest likelihood (50 nats below it, and gains five times too large, in a room
of 0.1 m). Between members likelihoods decide, so these are climbed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nsde_torch.sysid.regression import Regression

Array = NDArray[np.float64]
_ITERATIONS = 15
_SETTLED = 0.02
"""Log-likelihood that a step promises, below which the search ends [nats]."""
_SHORTEST = 0.03  # of a step that made it less


def log_likelihood(fit: Regression) -> float:
    """Log-likelihood of the rows of a fit, less one for each parameter of its noise models [nats]."""
    rows = fit.white.shape[1]
    laws = sum(law.likelihood(rows) for law in fit.noises)
    return float(laws - 0.5 * np.square(fit.white).sum())


def likeliest(fit: Regression, start: Array, known: Array, centre: Array) -> tuple[float, Regression]:
    """The largest log-likelihood with what is known else [nats], and the fit that has it.

    Args:
        fit: A regression; its noise models give their kind.
        start: Parameters to start from (k,).
        known: What is known of the parameters without its rows, as information (k, k).
        centre: Where that says that they are (k,).
    """
    v, best, at, share = fit.vector, -np.inf, fit, 1.0
    theta = v.inside(start)
    step: Array = np.zeros(len(start))
    for _ in range(_ITERATIONS):
        tried = fit.at(theta)
        away = theta - centre
        nats = log_likelihood(tried) - 0.5 * float(away @ known @ away)
        if nats < best:  # too far: half the way back
            share *= 0.5
        else:
            best, at, share = nats, tried, 1.0
            flat = tried.slopes.reshape(-1, len(theta))
            info = flat.T @ flat + known
            step = np.asarray(np.linalg.solve(info, flat.T @ tried.white.reshape(-1) - known @ away))
            if 0.5 * float(step @ info @ step) < _SETTLED:
                break
        if share < _SHORTEST:
            break
        theta = v.inside(at.theta + share * step)
    return best, at


def with_values(fit: Regression, other: Regression) -> Array:
    """Parameters of a fit (k,) with the values that another fit has of those that both have."""
    theirs = dict(zip(other.vector.labels, other.theta, strict=True))
    return np.array([theirs.get(k, own) for k, own in zip(fit.vector.labels, fit.theta, strict=True)])
