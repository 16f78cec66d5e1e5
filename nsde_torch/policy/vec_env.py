"""A batch environment with the face that stable-baselines3 steps: one VecEnv for all machines, no process each."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, final

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from nsde_torch.policy.environment import BatchEnvironment, CartpoleSwingUp, Dynamics

_BOUND = 1e3


def observation_space(task: CartpoleSwingUp) -> spaces.Box:
    """What a policy may see: any numbers that `BatchEnvironment` lets through."""
    return spaces.Box(-_BOUND, _BOUND, (len(task.observation_names),), np.float32)


def action_space(task: CartpoleSwingUp) -> spaces.Box:
    """What a policy may do."""
    return spaces.Box(-1.0, 1.0, (len(task.action_names),), np.float32)


@final
class PolicyVecEnv(VecEnv):
    """All machines of a batch environment as one vectorised environment.

    Args:
        environment: The machines.
        reward_scale: Factor on the rewards that the learner sees; `infos[...]["episode"]["r"]` is without it.
    """

    def __init__(self, environment: BatchEnvironment, *, reward_scale: float = 1.0) -> None:
        self.environment, self.reward_scale = environment, reward_scale
        self._action = torch.zeros(0)
        super().__init__(environment.n, observation_space(environment.task), action_space(environment.task))

    def reset(self) -> NDArray[np.float32]:
        """Start all episodes; returns what the policy sees (N, no)."""
        return _array(self.environment.reset())

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Take the actions (N, na) of the next step."""
        self._action = torch.as_tensor(actions)

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
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
        """Call a method, once for all machines."""
        result = getattr(self, method_name)(*args, **kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """No machine is wrapped."""
        rows: Iterable[int] = self._get_indices(indices)
        return [False for _ in rows]


def _array(values: torch.Tensor) -> NDArray[np.float32]:
    array: NDArray[np.float32] = values.numpy()
    return array


@final
class PolicyEnv(gymnasium.Env[Any, Any]):
    """A task on one machine.

    Args:
        task: What is asked for.
        make_dynamics: Makes the machine from a source of randomness.
        seed: Seed until `reset` is given another.

    Example:
        >>> def plant(generator):
        ...     return make_truth("plant", system="cartpole", dt=0.02, sensor_noise=1.0, generator=generator)
        >>> env = PolicyEnv(make_task("cartpole"), plant, seed=0)
    """

    metadata = {"render_modes": []}

    def __init__(
        self, task: CartpoleSwingUp, make_dynamics: Callable[[torch.Generator], Dynamics], *, seed: int
    ) -> None:
        self.observation_space, self.action_space = observation_space(task), action_space(task)
        self._generator = torch.Generator().manual_seed(seed)
        self.environment = BatchEnvironment(
            task, make_dynamics(self._generator), n=1, generator=self._generator, start=task.training
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of everything random from here on; None goes on with the one before.
            options: `x0`, the first true state (nx,), instead of a random one.

        Returns:
            What the policy sees (no,), and nothing more.
        """
        super().reset(seed=seed)
        if seed is not None:
            self._generator.manual_seed(seed)
        x0 = (options or {}).get("x0")
        start = None if x0 is None else torch.as_tensor(np.asarray(x0, dtype=np.float64))[None]
        return self.environment.reset(start)[0].numpy(), {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Advance by one step under an action (na,); after the end of an episode comes `reset`.

        Returns:
            What the policy sees, reward, terminated, truncated, and nothing more.
        """
        made = self.environment.step(torch.as_tensor(np.asarray(action, dtype=np.float32))[None])
        ended = (bool(made.terminated[0]), bool(made.truncated[0]))
        return (made.last[0].numpy(), float(made.reward[0]), *ended, {})
