"""Errors of predictions over many steps, inputs replayed from the log, of physics without noise."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.columns import few_operations
from nsde_torch.data import Windows
from nsde_torch.evaluation.scores import group_squares
from nsde_torch.models.before import inputs_before
from nsde_torch.models.identified import IdentifiedModel
from nsde_torch.sde import make_step
from nsde_torch.systems.parameters import ParameterVector


@torch.no_grad()
def rollout_squares(model: IdentifiedModel, windows: Windows, starts: Tensor, steps: Sequence[int]) -> Tensor:
    """Squared errors (S, horizons, groups) of predictions by Runge and Kutta; not finite where one diverged.

    A prediction that leaves the finite numbers does so alone, and does not stop the others.

    Args:
        model: The physics.
        windows: Windows of at least as many steps.
        starts: Window numbers (S,).
        steps: Horizons.
    """
    return _advanced(model, windows.dt_model, steps, *_begun(model, windows, starts))


@torch.no_grad()
def squares_by_fold(
    model: IdentifiedModel,
    windows: Windows,
    starts: Tensor,
    steps: Sequence[int],
    *,
    values: NDArray[np.float64],
    fold: NDArray[np.int64],
) -> Tensor:
    """As `rollout_squares`, with values of the parameters for each fold of the starts; all folds at once.

    Args:
        model: The physics.
        windows, starts, steps: See `rollout_squares`.
        values: Of its parameters, as in `ParameterVector` (folds, k).
        fold: Of each start (S,).
    """
    vector = ParameterVector(model.system)
    model.system, thetas, begun = vector.system, torch.from_numpy(values), []
    rows = [np.flatnonzero(fold == f) for f in range(len(thetas))]
    most = max(map(len, rows))
    for own, theta in zip(rows, thetas, strict=True):
        vector.use(theta)
        begun.append(_begun(model, windows, starts[np.resize(own, most)]))

    def one(theta: Tensor, *parts: Tensor) -> Tensor:
        vector.use(theta)
        return _advanced(model, windows.dt_model, steps, *parts)

    try:
        with few_operations():
            squares = torch.func.vmap(one)(thetas, *map(torch.stack, zip(*begun, strict=True)))
    except RuntimeError:  # an effect of the user's own that branches on its values
        squares = torch.stack([one(theta, *parts) for theta, parts in zip(thetas, begun, strict=True)])
    out = squares.new_empty(len(starts), *squares.shape[2:])
    for own, part in zip(rows, squares, strict=True):
        out[own] = part[: len(own)]
    return out


def _begun(model: IdentifiedModel, windows: Windows, starts: Tensor) -> tuple[Tensor, ...]:
    """States with their memory, measured states, inputs and times of the starts of predictions."""
    x, u, t0 = windows.batch(starts)
    before, dt = inputs_before(model.system, windows, starts), windows.dt_model
    model.set_step(dt)
    return model.remembered(x[:, 0], u[:, 0], before, dt=dt), x, u, t0


def _advanced(
    model: IdentifiedModel, dt: float, steps: Sequence[int], z: Tensor, x: Tensor, u: Tensor, t0: Tensor
) -> Tensor:
    system, solver, out = model.system, make_step("rk4"), {}
    for k in range(max(steps)):
        z = system.project(solver.advance(model, t0[:, None] + k * dt, z, u[:, k], dt, None))
        if k + 1 in steps:
            out[k + 1] = group_squares(system, system.error(z[:, : system.nx], x[:, k + 1]))
    return torch.stack([out[k] for k in steps], 1)
