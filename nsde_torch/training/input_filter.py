"""A model's input filter for logs whose inputs were averaged, from inputs that were restored (`recording.smoothing`).

The filter's taps are those with which the logged inputs come nearest to the restored ones, in means over model steps.
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from nsde_torch.data import Run
from nsde_torch.models.input_filter import InputFilter

Array = NDArray[np.float64]


@torch.no_grad()
def fit_filter(target: InputFilter, logged: Sequence[Run], restored: Sequence[Run], n_inputs: int) -> None:
    """Set the weights of a filter by least squares.

    Args:
        target: Changed in place.
        logged: Runs as logged.
        restored: The same runs with inputs as they acted.
        n_inputs: Number of inputs.
    """
    reach, rows, wanted = target.reach, [], []
    stride = max(1, round(target.dt / logged[0].dt))
    for before, after in zip(logged, restored, strict=True):
        for a, b in before.segments:
            u, v = (_means(np.asarray(run.u[a:b, :n_inputs]), stride) for run in (before, after))
            if len(u) <= 2 * reach:
                continue
            parts = [u[reach + lag : len(u) - reach + lag] for lag in range(-reach, reach + 1)]
            rows.append(np.stack(parts, 2).reshape(-1, 2 * reach + 1))
            wanted.append((v - u)[reach : len(u) - reach].reshape(-1))
    if not rows:
        return
    x, y = np.concatenate(rows), np.concatenate(wanted)
    centred = x - x.mean(1, keepdims=True)  # the weights' mean does not count
    ridge = 1e-6 * np.trace(centred.T @ centred) / len(centred.T) * np.eye(len(centred.T))
    weights = np.linalg.solve(centred.T @ centred + ridge, centred.T @ y)
    target.weights.copy_(torch.as_tensor(weights - weights.mean()))


def _means(u: Array, stride: int) -> Array:
    """Means over `stride` rows from every row on (n - stride + 1, nu), one in `stride` of them; none of fewer rows."""
    count = len(u) // stride
    return np.asarray(u[: count * stride].reshape(count, stride, u.shape[1]).mean(1))
