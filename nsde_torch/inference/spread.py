"""Covariance of least-squares estimates from blocks of time, whatever is left of correlation and of uneven noise.

    V = M^-1 (sum_c s_c s_c') M^-1,    M = X' X,    s_c = X_c' (I - X_c M^-1 X_c')^-1 e_c

is the jackknife over blocks c: M^-1 s_c is how far the estimate moves when block c is left out (CR3: Bell and
McCaffrey, Survey Methodology 28 (2002)). It errs on the side of wide intervals, which the fitted noise model, that
X takes for known, uses up. A parameter that a few blocks decide has few degrees of freedom,
(sum_c w_c)^2 / sum_c w_c^2 with w_c the share of block c in its variance, for Student's t.
"""

from dataclasses import dataclass

import numpy as np

from nsde_torch.arrays import Array, Labels


@dataclass(frozen=True)
class Spread:
    """How sure an estimate is."""

    covariance: Array  # of the estimate (r, r)
    parts: Array  # change of the estimate by each block, against leaving it out (C, r)
    weights: Array  # variance that each block brings if noise is white and even, (C, r, r)

    def degrees(self, directions: Array) -> Array:
        """Degrees of freedom of combinations (k, r) of the estimate, (k,)."""
        w = np.einsum("kr,crs,ks->ck", directions, self.weights, directions)
        return np.asarray(w.sum(0) ** 2 / np.maximum(np.square(w).sum(0), 1e-300))


def spread(slopes: Array, residual: Array, blocks: Labels, used: int) -> Spread:
    """Covariance of the least-squares estimate at its optimum.

    Args:
        slopes: Whitened slopes of all channels (channels, N, r), of full rank r; r may be nothing.
        residual: Whitened residuals (channels, N).
        blocks: Block of each row (N,).
        used: Number of parameters of the noise that were fitted to the same rows.

    Raises:
        LinAlgError: slopes of less than full rank.
    """
    channels, rows, r = slopes.shape
    count = int(blocks.max()) + 1
    if not r:
        return Spread(np.zeros((0, 0)), np.zeros((count, 0)), np.zeros((count, 0, 0)))
    # in the coordinates that make M the identity the powers of (I - H) are those of r x r matrices
    triangle = np.linalg.qr(slopes.reshape(-1, r), mode="r")
    back = np.linalg.inv(triangle)
    x = slopes @ back
    score, share = np.zeros((count, r)), np.zeros((count, r, r))
    np.add.at(score, blocks, np.einsum("cnr,cn->nr", x, residual))
    for c in range(count):
        part = x[:, blocks == c].reshape(-1, r)
        share[c] = part.T @ part
    values, vectors = np.linalg.eigh(share)
    values = np.clip(values, 0.0, 0.999)
    restore = np.einsum("cij,cj,ckj->cik", vectors, (1.0 - values) ** -1, vectors)
    weight = np.einsum("cij,cj,ckj->cik", vectors, values / (1.0 - values), vectors)
    parts = np.einsum("cij,cj->ci", restore, score) @ back.T
    total = channels * rows
    factor = total / max(total - r - used, 1)
    return Spread(factor * parts.T @ parts, parts, back @ weight @ back.T)
