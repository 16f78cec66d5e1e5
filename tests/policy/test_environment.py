"""The swing-up task and batches of it: the truth is the plant, machines are rows, episodes end as they should."""

from math import cos, pi, sin
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from nsde_torch.errors import ConfigError
from nsde_torch.policy import BatchEnvironment, Box, Dynamics, make_task, make_truth
from nsde_torch.policy.learned import PUBLISHED_VARIANCES
from nsde_torch.recording import read
from nsde_torch.simulation import make_plant
from nsde_torch.systems import make_system
from tests.helpers.draws import generator

TASK = make_task("cartpole")


def test_reward_is_its_formula() -> None:
    x = torch.tensor([[2.0, -3.0, pi / 3, 4.0]])
    reward = TASK.reward(x, torch.tensor([[-0.5]]))
    assert float(reward) == pytest.approx(0.5 - 0.02 - 0.5 - 0.4 - 0.3, abs=1e-6)


def test_policy_sees_direction_and_not_turns() -> None:
    x = torch.tensor([[0.1, 0.2, 0.3, 0.4], [0.1, 0.2, 0.3 + 2 * pi, 0.4]])
    seen = TASK.observe(x)
    torch.testing.assert_close(seen[0], seen[1])
    assert seen.shape[1] == len(TASK.observation_names) == len(TASK.observation_scale)


def test_system_without_a_task_is_refused_with_those_that_have_one() -> None:
    with pytest.raises(ConfigError, match="cartpole"):
        make_task("hexacopter")


def quiet(name: str = "plant") -> Dynamics:
    """A truth without noise of any kind."""
    given = {"dt": TASK.dt, "sensor_noise": 0.0, "generator": generator()}
    if name == "plant":
        return make_plant("cartpole", process_noise=0.0, check=False, **given)
    return make_truth(name, system="cartpole", **given)


def environment(dynamics: Dynamics, n: int, x0: Tensor | None = None) -> BatchEnvironment:
    """Machines that begin anywhere, or all in one state."""
    start = TASK.training if x0 is None else Box(*[tuple(x0.tolist())] * 2)
    return BatchEnvironment(TASK, dynamics, n=n, generator=generator(), start=start)


class Diverging(Dynamics):
    """The first machine leaves the finite numbers in its third step; the others stand still."""

    name, state, steps = "diverging", torch.zeros(0, 4), 0

    def reset(self, x0: Tensor) -> Tensor:
        self.state = torch.zeros_like(x0)
        return self.state

    def restart(self, rows: Tensor, x0: Tensor) -> Tensor:
        self.state = self.state.index_copy(0, rows, torch.zeros_like(x0))
        return self.state[rows]

    def step(self, u: Tensor) -> Tensor:
        self.steps += 1
        if self.steps == 3:
            self.state = self.state.index_fill(0, torch.tensor([0]), torch.nan)
        return self.state


@pytest.mark.parametrize("name", ["plant", "published"])
def test_machines_in_a_batch_do_what_each_does_alone(name: str) -> None:
    x0 = TASK.training.draw(4, generator())
    actions = 2 * torch.rand(30, 4, 1, generator=generator(1)) - 1
    together = environment(quiet(name), 4)
    seen = [together.reset()]
    rewards = []
    for action in actions:
        made = together.step(action)
        seen.append(made.observation)
        rewards.append(made.reward)
    for row in range(4):
        alone = environment(quiet(name), 1, x0[row])
        torch.testing.assert_close(alone.reset()[0], seen[0][row])
        for k, action in enumerate(actions):
            made = alone.step(action[row : row + 1])
            torch.testing.assert_close(made.observation[0], seen[k + 1][row], rtol=0, atol=1e-5)
            torch.testing.assert_close(made.reward[0], rewards[k][row], rtol=0, atol=1e-6)


def test_published_truth_is_eulers_method_on_the_gym_cartpole() -> None:
    x, v, theta, w = 0.3, -0.4, 2.9, 0.5
    truth = quiet("published")
    truth.reset(torch.tensor([[x, v, theta, w]], dtype=torch.float64))
    for k in range(100):
        action = sin(0.3 * k)
        push = (25.0 * action + 0.05 * w**2 * sin(theta)) / 1.1
        turn = (9.8 * sin(theta) - cos(theta) * push) / (0.5 * (4 / 3 - 0.1 * cos(theta) ** 2 / 1.1))
        accelerate = push - 0.05 * turn * cos(theta) / 1.1
        x, v, theta, w = x + 0.02 * v, v + 0.02 * accelerate, theta + 0.02 * w, w + 0.02 * turn
        truth.step(torch.tensor([[25.0 * action]]))
    np.testing.assert_allclose(truth.state[0].numpy(), [x, v, theta, w], rtol=1e-4, atol=1e-4)


@pytest.mark.published
@pytest.mark.parametrize("name", ["learned", "random"])
def test_published_truth_leaves_of_the_published_data_its_sensor_noise(published: Path, name: str) -> None:
    runs = read("published", make_system("cartpole"), path=published / "cartpole" / f"{name}.pkl").runs
    truth = quiet("published")
    left = []
    for run in runs[:50]:
        x, u = torch.as_tensor(np.array(run.x)), torch.as_tensor(np.array(run.u))
        truth.reset(x[:-1])
        truth.step(u[: len(x) - 1])
        left.append((x[1:] - truth.state).numpy())
    std = np.concatenate(left).std(0) / 2**0.5  # both ends are noisy
    np.testing.assert_allclose(std, np.sqrt(PUBLISHED_VARIANCES), rtol=0.06)


def test_episode_is_cut_off_after_its_steps_and_the_next_begins() -> None:
    true = environment(quiet(), 3)
    true.reset()
    total = torch.zeros(3, dtype=torch.float64)
    for k in range(TASK.steps):
        made = true.step(torch.zeros(3, 1))
        total += made.reward
        assert bool(made.truncated.all()) == (k == TASK.steps - 1)
        assert not bool(made.terminated.any())
    assert made.length.tolist() == [TASK.steps] * 3
    torch.testing.assert_close(made.total, total)
    assert not torch.equal(made.last, made.observation)
    low = torch.tensor(TASK.training.low)
    assert bool((true.dynamics.state >= low - 1e-9).all())
    assert true.step(torch.zeros(3, 1)).length.tolist() == [1] * 3


def test_leaving_the_track_ends_an_episode_and_does_not_pay() -> None:
    true = environment(quiet(), 1, torch.tensor([119.9, 20.0, pi, 0.0]))
    true.reset()
    made = true.step(torch.zeros(1, 1))
    assert (made.terminated.tolist(), made.truncated.tolist()) == ([True], [False])
    # cos(pi), 1.2 of the position and 2 of the speed, at each of the 200 steps
    assert float(made.total[0]) == pytest.approx(-200 * (1 + 1.203 + 2.0), rel=1e-3)
    assert made.length.tolist() == [1]


def test_machine_that_leaves_the_finite_numbers_ends_its_episode_alone() -> None:
    machines = environment(Diverging(), 3)
    machines.reset()
    ended = []
    for _ in range(5):
        made = machines.step(torch.zeros(3, 1))
        ended.append(made.terminated.tolist())
        assert bool(torch.isfinite(made.observation).all())
        assert bool(torch.isfinite(made.last).all())
        assert bool(torch.isfinite(made.reward).all())
    assert ended == [[False] * 3, [False] * 3, [True, False, False], [False] * 3, [False] * 3]
