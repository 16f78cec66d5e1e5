"""One machine with the plain face of gymnasium, for use by other learners and for looking at a policy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from nsde_torch.policy.dynamics import Dynamics
from nsde_torch.policy.environment import BatchEnvironment
from nsde_torch.policy.task import CartpoleSwingUp
from nsde_torch.policy.vec_env import action_space, observation_space


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
        """Advance by one step; after the end of an episode comes `reset`.

        Args:
            action: Action (na,).

        Returns:
            What the policy sees, reward, terminated, truncated, and nothing more.
        """
        made = self.environment.step(torch.as_tensor(np.asarray(action, dtype=np.float32))[None])
        return (
            made.last[0].numpy(),
            float(made.reward[0]),
            bool(made.terminated[0]),
            bool(made.truncated[0]),
            {},
        )
