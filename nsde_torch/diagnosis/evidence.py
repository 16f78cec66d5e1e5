"""How much better one regression explains the runs than another, judged where it was not fitted.

Whitened residuals w are independent with unit variance under the noise model that was fitted, so that over rows of
a block b

    log p_b = -sum_b (w^2 / 2 + log std)

With normal equations G_f = X_f' X_f, g_f = X_f' w_f per fold f, the parameters without fold f are, from the optimum,
d_f = (G - G_f)^-1 (g - g_f): leaving whole runs out costs no further fit. The difference of log p between two
models, summed over left-out runs, is the evidence; its scatter over blocks of time says how sure it is (Vuong,
Econometrica 57, 1989).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc, stdtr

from nsde_torch.diagnosis.decisions import DECISIONS, Decisions
from nsde_torch.diagnosis.fitted import at_bounds
from nsde_torch.inference.spread import Spread
from nsde_torch.sysid.regression import Regression

Array = NDArray[np.float64]
Labels = NDArray[np.int64]
Flags = NDArray[np.bool_]

_FLAT = 1e-9  # of the largest singular value: directions that move nothing
_LIVE = 1e-12  # of the largest variance: parameters that the data do not see


@dataclass(frozen=True)
class Score:
    """How well a regression does on rows that it was not fitted to."""

    # log likelihood of each block of time with its fold left out (B,); `fitted`'s price is spread over them
    blocks: Array
    fitted: float  # log likelihood of all rows as fitted, less one for each parameter of the noise (Akaike)
    free: int  # number of parameters that the data show


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


def score(regression: Regression, fold: Labels, block: Labels, *, still: Flags) -> Score:
    """Score of a regression at its optimum.

    Args:
        regression: The regression.
        fold: Fold of each whitened row.
        block: Block of time of each whitened row.
        still: Parameters that folds take as all rows gave them (k,): shapes, in which steps are far from linear.
    """
    white, x = regression.white, regression.slopes @ free_basis(regression, still)
    r = x.shape[2]
    gram, pull = np.zeros((int(fold.max()) + 1, r, r)), np.zeros((int(fold.max()) + 1, r))
    for f in range(len(gram)):
        rows = fold == f
        part = x[:, rows].reshape(white[:, rows].size, r)  # r may be 0: nothing is shown
        gram[f], pull[f] = part.T @ part, part.T @ white[:, rows].reshape(-1)
    total, rest = gram.sum(0), pull.sum(0)
    out = white.copy()
    for f in range(len(gram)):
        rows = fold == f
        if r:
            step = np.linalg.lstsq(total - gram[f], rest - pull[f], rcond=1e-10)[0]
            out[:, rows] -= x[:, rows] @ step
    log_std = np.log([n.std for n in regression.noises])
    each = -0.5 * np.square(out) - log_std[:, None]
    blocks: Array = np.bincount(block, weights=each.sum(0), minlength=int(block.max()) + 1).astype(np.float64)
    price = sum(n.parameters for n in regression.noises)
    blocks -= price / len(blocks)
    fitted = float(-0.5 * np.square(white).sum() - log_std.sum() * white.shape[1]) - price
    return Score(blocks, fitted, regression.shown.rank)


def free_basis(regression: Regression, still: Flags) -> Array:
    """Directions (k, r) that the data show, without parameters that are still or stand at a bound.

    Args:
        regression: The regression.
        still: Parameters that do not move (k,).
    """
    v = regression.vector
    held = still | at_bounds(regression)
    basis = regression.shown.basis.copy()
    if not held.any() or not basis.shape[1]:
        return basis
    # directions in the span of `basis` that do not move what is held
    _, values, rows = np.linalg.svd((basis / v.scale[:, None])[held])
    rank = int((values > _FLAT * max(values[0], 1e-300)).sum())
    return np.asarray(basis @ rows[rank:].T)


def p_value(regression: Regression, tested: Flags, sure: Spread, *, base: Score, this: Score) -> float:
    """Chance of so large a gain if the added parameters did nothing.

    Two tests, and twice the smaller chance. The likelihood ratio is divided by what blocks of time say of its size
    beyond white noise (at least 1) and referred to an F distribution with the degrees of freedom of those blocks:
    strong where an effect acts all the time. The evidence on rows left out is compared with its scatter over blocks
    (Student's t, with as many degrees of freedom as blocks that count): strong where few blocks carry an effect.

    Args:
        regression: With the effect, at its optimum.
        tested: Parameters that the effect added and whose noise counts (k,): those that are nothing without it.
        sure: Covariance from blocks in the directions shown.
        base: Score without the effect.
        this: Score with it.
    """
    basis = regression.shown.basis[tested]
    count = max(this.free - base.free, 1)
    flat = (regression.slopes @ regression.shown.basis).reshape(regression.white.size, regression.shown.rank)
    model = np.linalg.pinv(flat.T @ flat)
    robust, plain = np.diag(basis @ sure.covariance @ basis.T), np.diag(basis @ model @ basis.T)
    live = plain > _LIVE * max(float(plain.max()), 1e-300)
    if not live.any():
        return 1.0
    widened = max(1.0, float((robust[live] / plain[live]).mean()))
    degrees = max(float(sure.degrees(basis)[live].min()), 1.0)
    ratio = max(2.0 * (this.fitted - base.fitted), 0.0)
    by_ratio = float(fdtrc(count, degrees, ratio / widened / count))
    return min(1.0, 2.0 * min(by_ratio, by_blocks(this.blocks - base.blocks)))


def by_blocks(difference: Array) -> float:
    """Chance of so large a sum over blocks if its mean were 0."""
    squares = float(np.square(difference).sum())
    if not squares > 0:
        return 1.0
    counting = float(np.abs(difference).sum()) ** 2 / squares
    return float(stdtr(max(counting - 1.0, 1.0), -float(difference.sum()) / sum_error(difference)))


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
