"""The swing-up task: reward, what is seen, first states."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
import torch

from nsde_torch.errors import ConfigError
from nsde_torch.policy import Box, make_task

TASK = make_task("cartpole")


def test_reward_is_its_formula() -> None:
    x = torch.tensor([[2.0, -3.0, pi / 3, 4.0]])
    reward = TASK.reward(x, torch.tensor([[-0.5]]))
    assert float(reward) == pytest.approx(0.5 - 0.02 - 0.5 - 0.4 - 0.3, abs=1e-6)


def test_reward_takes_the_clipped_action_and_has_a_floor() -> None:
    still = torch.zeros(1, 4)
    assert float(TASK.reward(still, torch.tensor([[7.0]]))) == pytest.approx(0.0)
    absurd = torch.tensor([[0.0, 1e9, 0.0, 0.0], [torch.nan, 0.0, 0.0, 0.0], [0.0, 0.0, torch.inf, 0.0]])
    assert TASK.reward(absurd, torch.zeros(3, 1)).tolist() == [TASK.lowest] * 3


def test_full_action_is_the_force_of_the_published_data() -> None:
    assert TASK.command(torch.tensor([[-2.0], [0.5]])).tolist() == [[-25.0], [12.5]]


def test_policy_sees_direction_and_not_turns() -> None:
    x = torch.tensor([[0.1, 0.2, 0.3, 0.4], [0.1, 0.2, 0.3 + 2 * pi, 0.4]])
    seen = TASK.observe(x)
    torch.testing.assert_close(seen[0], seen[1])
    assert seen.shape[1] == len(TASK.observation_names) == len(TASK.observation_scale)


@pytest.mark.parametrize("box", [TASK.training, TASK.evaluation])
def test_first_states_fill_their_box(box: Box) -> None:
    drawn = box.draw(2000, torch.Generator().manual_seed(0)).numpy()
    low, high = np.array(box.low), np.array(box.high)
    assert (drawn >= low).all()
    assert (drawn <= high).all()
    np.testing.assert_allclose(drawn.min(0), low, atol=0.01 * (high - low).max())
    np.testing.assert_allclose(drawn.max(0), high, atol=0.01 * (high - low).max())


def test_system_without_a_task_is_refused_with_those_that_have_one() -> None:
    with pytest.raises(ConfigError, match="cartpole"):
        make_task("hexacopter")
