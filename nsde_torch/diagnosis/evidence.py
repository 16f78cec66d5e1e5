"""How likely residuals are under regressions with noise models of their own, by channel and by block of time."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr

from nsde_torch.diagnosis.decisions import DECISIONS, Decisions
from nsde_torch.sysid.regression import Regression

Array = NDArray[np.float64]
Labels = NDArray[np.int64]


def folds(regression: Regression, decisions: Decisions = DECISIONS) -> Labels:
    """Fold of each whitened row: whole runs, or groups of them; of one run or two, stretches of each.

    One run alone does not say what lasts from run to run: what falls with time over two would have to be foretold.

    Args:
        regression: The regression.
        decisions: Numbers of folds.
    """
    _, number = np.unique(regression.owners, return_inverse=True)
    count = int(number.max()) + 1
    if count >= decisions.folds_fewest_runs:
        return regression.whitened_rows((number * min(count, decisions.folds) // count).astype(np.int64))
    rows, stretches = np.zeros(len(number), dtype=np.int64), decisions.folds_stretches
    for run in range(count):
        own = np.flatnonzero(number == run)
        rows[own] = stretches * run + np.arange(len(own)) * stretches // len(own)
    return regression.whitened_rows(rows)


def fitted_nats(regression: Regression) -> float:
    """Log likelihood of all rows as fitted, less one for each parameter of the noise [nats]."""
    log_std = float(np.log([n.std for n in regression.noises]).sum())
    price = sum(n.parameters for n in regression.noises)
    white = regression.white
    return float(-0.5 * np.square(white).sum()) - log_std * white.shape[1] - price


def by_blocks(difference: Array) -> float:
    """Chance of so large a sum over blocks if its mean were 0."""
    squares = float(np.square(difference).sum())
    if not squares > 0:
        return 1.0
    counting = float(np.abs(difference).sum()) ** 2 / squares
    return float(stdtr(max(counting - 1.0, 1.0), -float(difference.sum()) / sum_error(difference)))


@np.errstate(over="ignore")  # of a step that leaves the finite numbers in one block
def sum_error(difference: Array) -> float:
    """Standard error of a sum over blocks, from their scatter."""
    return float(difference.std(ddof=1)) * len(difference) ** 0.5


def nats_by_channel(before: Regression, after: Regression) -> dict[str, float]:
    """Log-likelihood, as fitted, that one regression has beyond another, by channel [nats]."""

    def fitted(r: Regression) -> dict[str, float]:
        rows = r.white.shape[1]
        return {
            r.physics.names[c]: -0.5 * float(w @ w) + law.likelihood(rows)
            for c, w, law in zip(r.rows, r.white, r.noises, strict=True)
        }

    first, second = fitted(before), fitted(after)
    return {name: second[name] - first[name] for name in first}
