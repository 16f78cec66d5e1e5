"""The faces that gymnasium and stable-baselines3 know, held against their own checkers."""

import warnings

import numpy as np
import pytest
import torch

from nsde_torch.policy import BatchEnvironment, Dynamics, make_task, make_truth

pytest.importorskip("gymnasium", reason="needs the extra nsde_torch[policy]")
pytest.importorskip("stable_baselines3", reason="needs the extra nsde_torch[policy]")

from gymnasium.utils.env_checker import check_env
from stable_baselines3.common import env_checker as sb3_checker

from nsde_torch.policy.vec_env import PolicyEnv, PolicyVecEnv

TASK = make_task("cartpole")


def plant(generator: torch.Generator, sensor_noise: float = 1.0) -> Dynamics:
    return make_truth("plant", system="cartpole", dt=TASK.dt, sensor_noise=sensor_noise, generator=generator)


def single() -> PolicyEnv:
    return PolicyEnv(TASK, plant, seed=0)


def many(n: int, *, reward_scale: float = 1.0) -> PolicyVecEnv:
    generator = torch.Generator().manual_seed(0)
    machines = BatchEnvironment(TASK, plant(generator), n=n, generator=generator, start=TASK.training)
    return PolicyVecEnv(machines, reward_scale=reward_scale)


def test_gymnasium_finds_nothing_amiss_with_the_single_environment() -> None:
    with warnings.catch_warnings():
        # that an environment has no `spec` is said of every one that is not registered by name
        warnings.filterwarnings("ignore", ".*spec.*")
        check_env(single(), skip_render_check=True)


def test_stable_baselines_finds_nothing_amiss_with_the_single_environment() -> None:
    sb3_checker.check_env(single(), warn=True, skip_render_check=True)


def test_single_environment_repeats_an_episode_of_the_same_seed() -> None:
    def play(seed: int | None) -> list[np.ndarray]:
        env = single()
        seen = [env.reset(seed=seed)[0]]
        seen += [env.step(np.array([0.3], dtype=np.float32))[0] for _ in range(5)]
        return seen

    np.testing.assert_array_equal(play(5), play(5))
    assert not np.array_equal(play(5), play(6))


def test_single_environment_starts_where_it_is_told() -> None:
    env = PolicyEnv(TASK, lambda generator: plant(generator, 0.0), seed=0)
    seen, info = env.reset(options={"x0": [0.1, 0.2, 0.0, 0.3]})
    np.testing.assert_allclose(seen, [0.1, 0.2, 0.0, 1.0, 0.3], atol=1e-6)
    assert info == {}


def test_single_environment_gives_the_last_observation_of_an_episode() -> None:
    env = PolicyEnv(TASK, lambda generator: plant(generator, 0.0), seed=0)
    env.reset(options={"x0": [0.0, 5.0, np.pi, 0.0]})
    made = [env.step(np.zeros(1, dtype=np.float32)) for _ in range(TASK.steps)]
    assert [m[3] for m in made] == [False] * (TASK.steps - 1) + [True]
    assert made[-1][0][0] > made[-2][0][0] > 15  # the cart has rolled on; a new episode starts within 1 m


def test_vectorised_environment_has_the_shapes_and_types_of_a_vecenv() -> None:
    env = many(3)
    seen = env.reset()
    assert env.num_envs == 3
    assert seen.shape == (3, 5)
    assert seen.dtype == np.float32
    seen, rewards, dones, infos = env.step(np.zeros((3, 1), dtype=np.float32))
    assert seen.shape == (3, 5)
    assert rewards.shape == dones.shape == (3,)
    assert (rewards.dtype, dones.dtype) == (np.float32, np.bool_)
    assert infos == [{}, {}, {}]
    assert env.get_attr("reward_scale", [0, 2]) == [1.0, 1.0]
    assert env.env_is_wrapped(object) == [False] * 3  # type: ignore[arg-type]
    assert env.render_mode is None


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
