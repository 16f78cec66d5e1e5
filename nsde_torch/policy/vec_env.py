"""A batch environment with the face that stable-baselines3 steps: one VecEnv for all machines, no process each."""

from __future__ import annotations

from typing import Any, final

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from nsde_torch.policy.environment import BatchEnvironment

_BOUND = 1e3  # of what a policy may see: any numbers that `BatchEnvironment` lets through


@final
class PolicyVecEnv(VecEnv):
    """All machines of a batch environment as one vectorised environment.

    `reward_scale` is a factor on the rewards that the learner sees; `infos[...]["episode"]["r"]` is without it.
    """

    def __init__(self, environment: BatchEnvironment, *, reward_scale: float = 1.0) -> None:
        self.environment, self.reward_scale = environment, reward_scale
        self._action, task = torch.zeros(0), environment.task
        seen = spaces.Box(-_BOUND, _BOUND, (len(task.observation_names),), np.float32)
        super().__init__(environment.n, seen, spaces.Box(-1.0, 1.0, (len(task.action_names),), np.float32))

    def reset(self) -> NDArray[np.float32]:
        """Start all episodes; returns what the policy sees (N, no)."""
        return _array(self.environment.reset())

    def step_async(self, actions: NDArray[np.float32]) -> None:
        self._action = torch.as_tensor(actions)

    def step_wait(self) -> tuple[Any, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Advance all machines; an episode that ends is followed by the next at once."""
        made = self.environment.step(self._action)
        done = made.terminated | made.truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in done.nonzero()[:, 0].tolist():
            infos[row] = {
                "terminal_observation": _array(made.last[row]),
                "TimeLimit.truncated": bool(made.truncated[row]),
                "episode": {"r": float(made.total[row]), "l": int(made.length[row])},
            }
        rewards = _array((self.reward_scale * made.reward).float())
        return _array(made.observation), rewards, done.numpy(), infos

    def close(self) -> None:
        """Nothing is held open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the environment, once for each machine."""
        value = None if attr_name == "render_mode" else getattr(self, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of all machines; they have none of their own."""
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        result = getattr(self, method_name)(*args, **kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]


def _array(values: torch.Tensor) -> NDArray[np.float32]:
    array: NDArray[np.float32] = values.numpy()
    return array
