"""The faces that gymnasium and stable-baselines3 know, held against their own checkers."""

import numpy as np
import pytest
import torch

from nsde_torch.policy import BatchEnvironment, Dynamics, make_task, make_truth

pytest.importorskip("gymnasium", reason="needs the extra nsde_torch[policy]")
pytest.importorskip("stable_baselines3", reason="needs the extra nsde_torch[policy]")


from nsde_torch.policy.ppo import PolicyVecEnv

TASK = make_task("cartpole")


def plant(generator: torch.Generator, sensor_noise: float = 1.0) -> Dynamics:
    return make_truth("plant", system="cartpole", dt=TASK.dt, sensor_noise=sensor_noise, generator=generator)


def many(n: int, *, reward_scale: float = 1.0) -> PolicyVecEnv:
    generator = torch.Generator().manual_seed(0)
    machines = BatchEnvironment(TASK, plant(generator), n=n, generator=generator, start=TASK.training)
    return PolicyVecEnv(machines, reward_scale=reward_scale)


def test_vectorised_environment_tells_of_the_end_of_an_episode() -> None:
    env = many(2, reward_scale=0.1)
    env.reset()
    total = np.zeros(2)
    for _ in range(TASK.steps):
        seen, rewards, dones, infos = env.step(np.zeros((2, 1), dtype=np.float32))
        total += rewards
    assert dones.all()
    for row, info in enumerate(infos):
        assert info["TimeLimit.truncated"]
        assert info["terminal_observation"].shape == (5,)
        assert not np.array_equal(info["terminal_observation"], seen[row])
        assert info["episode"]["l"] == TASK.steps
        assert info["episode"]["r"] == pytest.approx(10 * total[row], rel=1e-4)
