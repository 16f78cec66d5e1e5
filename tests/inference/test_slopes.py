"""Slopes of a step are those of the step itself: differences of Runge and Kutta's, with the machine's own values."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from nsde_torch.data import Run
from nsde_torch.inference.estimate import LogLikelihood
from nsde_torch.inference.state_space import StateSpace, moved
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import recorded

_BY = 1e-6


@pytest.fixture(scope="module")
def runs() -> Sequence[Run]:
    """A flight of the hexacopter."""
    few = {"variants": 2, "rounds": 1}
    return recorded("hexacopter", durations=(2.0,), seed=3, plant=few).runs


@pytest.fixture(scope="module")
def space(runs: Sequence[Run]) -> StateSpace:
    """A hexacopter with drag and motors that lag, at the states of its flight."""
    system = make_system("hexacopter", effects=["linear_drag", "motor_lag"])
    problem = LogLikelihood(system, runs)
    problem.space.use(problem.vector.start)
    return problem.space


def test_slopes_in_the_state_are_differences_of_steps(space: StateSpace) -> None:
    x, system = space.chunks.y, space.vector.system
    slopes, after = space.linearised(x)
    torch.testing.assert_close(after, space.after(x))
    for j in range(space.ne):
        error = torch.zeros(x[..., 0].numel(), space.ne, dtype=x.dtype)
        error[:, j] = _BY
        there = moved(system, x.flatten(0, 1), error).view(x.shape)
        differences = system.error(space.after(there), after) / _BY
        np.testing.assert_allclose(slopes[..., j], differences, atol=2e-4)


@pytest.mark.parametrize(
    "label", ["thrust_gain", "roll_gain", "linear_drag.drag[0]", "motor_lag.time_constant"]
)
def test_columns_are_differences_of_steps_to_second_order(space: StateSpace, label: str) -> None:
    x, v = space.chunks.y, space.vector
    j = v.labels.index(label)
    columns = space.columns(x, space.linearised(x)[0], [j])[..., 0]
    by = 1e-5 * v.scale[j]
    theta, here, error = space.theta.numpy().copy(), space.after(x), v.system.error
    space.use(theta + by * (np.arange(len(theta)) == j))
    differences = error(space.after(x), here) / by
    space.use(theta)
    assert float((columns - differences).norm()) < 3e-3 * float(differences.norm())


def test_what_moves_nothing_has_no_information_by_rounding(runs: Sequence[Run]) -> None:
    """More of all gains and as much less of all motors: what is left of it has to be far below 1e-10 of information."""
    system = make_system("hexacopter", effects=["motor_efficiency_loss"])
    space = LogLikelihood(system, runs).space
    v, x = space.vector, space.chunks.y
    theta = v.start.copy()
    theta[v.of("motor_efficiency_loss")] = [0.003, 0.003, 0.12, 0.001, 0.002, 0.05]
    space.use(theta)
    lost = [theta[j] if "gain" in v.labels[j] else 0.0 for j in range(len(v))]
    for j in v.of("motor_efficiency_loss"):
        lost[j] = 1.0 - theta[j]
    slopes, after = space.linearised(x)
    moved_by = space.columns(x, slopes, range(len(v)), after) * torch.tensor(lost, dtype=x.dtype)
    assert float(moved_by.sum(-1).norm()) < 3e-6 * float(moved_by.norm())
