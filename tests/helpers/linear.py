"""A linear regression with whitened rows, as evidence and intervals read it: the true model of what they claim."""

from types import SimpleNamespace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from nsde_torch.inference.spread import spread
from nsde_torch.sysid.regression import Regression, shown

Array = NDArray[np.float64]


def linear(x: Array, y: Array, blocks: NDArray[np.int64]) -> Regression:
    """The least-squares fit of y (N,) by x (N, k), at its optimum.

    Args:
        blocks: Block of time of each row (N,).
    """
    k = x.shape[1]
    theta = np.linalg.lstsq(x, y, rcond=None)[0] if k else np.zeros(0)
    white, what = (y - x @ theta)[None], shown(-x, np.ones(k))

    def covariance() -> object:
        return spread(-x[None] @ what.basis, white, blocks, 0)

    bounds = {"scale": np.ones(k), "low": np.full(k, -np.inf), "high": np.full(k, np.inf)}
    vector = SimpleNamespace(per_input=[], labels=[f"b_{j}" for j in range(k)], units=["1"] * k, **bounds)
    found = {"white": white, "slopes": -x[None], "theta": theta, "shown": what, "vector": vector}
    noises = [SimpleNamespace(std=1.0, parameters=0)]
    return cast(Regression, SimpleNamespace(noises=noises, spread=covariance, **found))


def lasting(rng: np.random.Generator, rows: int, blocks: NDArray[np.int64], share: float) -> Array:
    """Noise of unit variance (rows,), a share of which is the same all through a block of time."""
    level = rng.normal(size=int(blocks.max()) + 1)
    return np.asarray(share**0.5 * level[blocks] + (1 - share) ** 0.5 * rng.normal(size=rows))
