"""Chance that columns explain a whitened residual by accident, whatever the noise inside a block of time looks like.

With scores s_b = Z_b' w_b of B blocks of time, whose mean is 0 if nothing is missing,

    T = S' V^-1 S (B - q) / (q (B - 1)) ~ F(q, B - q),      S = sum s_b,  V from their scatter

(Hotelling, Annals of Mathematical Statistics 2 (1931)).
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, fdtrc

from nsde_torch.diagnosis.decisions import DECISIONS, Decisions
from nsde_torch.diagnosis.evidence import by_blocks

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

_NOTHING = 1e-9  # of the largest column: shorter is rounding
_NEW = 0.03  # of a column's length: what is left beside the others, below which it is one of them


def nats_of(z: Array, white: Array) -> float:
    """Log-likelihood that orthonormal columns (N, q) bring to whitened residuals (N,) [nats]."""
    return 0.5 * float(np.square(z.T @ white).sum())


def chance(
    z: Array,
    white: Array,
    fold: Labels,
    block: Labels,
    *,
    strong: bool = False,
    decisions: Decisions = DECISIONS,
) -> float:
    """p value of orthonormal columns (N, q): twice the smaller one of a test by blocks, and of folds left out.

    Args:
        z: The columns.
        white: What they are to explain (N,).
        fold, block: Labels of rows.
        strong: Whether they may explain so much that their own scatter over blocks hides it.
        decisions: How many blocks are enough.
    """
    by_block = jackknife if strong else hotelling
    steady = max(float(chdtrc(z.shape[1], 2.0 * nats_of(z, white))), by_block(z, white, block, decisions))
    return min(1.0, 2.0 * min(steady, left_out(z, white, fold, block)))


def left_out(z: Array, white: Array, fold: Labels, block: Labels) -> float:
    """Chance of the log likelihood that functions, fitted without a fold, gain on it, from its scatter over blocks."""
    each = np.zeros(len(white))
    whole, pull = z.T @ z, z.T @ white
    for f in range(int(fold.max()) + 1):
        rows = fold == f
        part = z[rows]
        weights = np.linalg.lstsq(whole - part.T @ part, pull - part.T @ white[rows], rcond=1e-8)[0]
        guess = part @ weights
        each[rows] = guess * (white[rows] - 0.5 * guess)
    return by_blocks(np.bincount(block, weights=each).astype(np.float64))


def hotelling(z: Array, white: Array, block: Labels, decisions: Decisions = DECISIONS) -> float:
    """p value of the sum of scores of blocks, whose scatter is taken with nothing explained."""
    scores: Array = np.zeros((int(block.max()) + 1, z.shape[1]))
    np.add.at(scores, block, z * white[:, None])
    centred = scores - scores.mean(0)
    factor = len(scores) / max(len(scores) - 1, 1)  # of a single block nothing is said
    return _of_scatter(scores.sum(0), centred.T @ centred, len(scores), factor, decisions)


def jackknife(z: Array, white: Array, block: Labels, decisions: Decisions = DECISIONS) -> float:
    """p value of coefficients whose scatter is that of leaving a block out: with everything explained.

    (Quenouille's and Tukey's jackknife; Bell, McCaffrey, Survey Methodology 28 (2002), for what it does to blocks
    that decide by themselves.)
    """
    pull, eye = z.T @ white, np.eye(z.shape[1])
    without = []
    for b in range(int(block.max()) + 1):
        part = z[block == b]
        rest = pull - part.T @ white[block == b]
        without.append(np.linalg.lstsq(eye - part.T @ part, rest, rcond=1e-10)[0])
    centred = np.array(without) - np.mean(without, 0)
    return _of_scatter(pull, centred.T @ centred, len(without), (len(without) - 1) / len(without), decisions)


def enough(blocks: int, functions: int, decisions: Decisions = DECISIONS) -> bool:
    """Whether blocks say something of the scatter of the scores of functions."""
    return blocks >= decisions.blocks_per_function * functions + decisions.blocks_beyond


def _of_scatter(total: Array, scatter: Array, count: int, factor: float, decisions: Decisions) -> float:
    """Hotelling's test of a total whose covariance is `factor` times a scatter of `count` blocks."""
    q = len(total)
    if not enough(count, q, decisions):
        return 0.0
    t2 = float(total @ np.linalg.pinv(scatter * factor, rcond=1e-10) @ total)
    return float(fdtrc(q, count - q, t2 * (count - q) / (q * (count - 1))))


def orthonormal(x: Array) -> Array:
    """Orthonormal columns (N, r) that span those of x (N, k)."""
    u, s, _ = np.linalg.svd(x, full_matrices=False)
    return (
        np.asarray(u[:, s > _NOTHING * max(float(s[0]), 1e-300)])
        if len(s) and s[0] > 0
        else np.zeros((len(x), 0))
    )


def independent(z: Array) -> tuple[Array, NDArray[np.int64]]:
    """Orthonormal columns in order (odd functions first keep their share), and which columns they came from."""
    size = np.linalg.norm(z, axis=0)
    kept: list[int] = []
    basis = np.zeros((len(z), 0))
    for k in range(z.shape[1]):
        if not size[k] > _NOTHING * max(float(size.max()), 1e-300):
            continue
        rest = z[:, k] - basis @ (basis.T @ z[:, k])
        rest = rest - basis @ (basis.T @ rest)
        length = float(np.linalg.norm(rest))
        if length > _NEW * size[k]:
            basis = np.column_stack((basis, rest / length))
            kept.append(k)
    return basis, np.array(kept, dtype=np.int64)
