"""Proximal policy optimisation on a batch environment, by stable-baselines3, which is imported here alone.

The learner sees observations over their scale and rewards times theirs. What it leaves behind, between updates,
goes into a file of tensors with plain words in its header, from which another process goes on: networks, Adam's
moments and the number of interactions. The episodes under way and the state of the random numbers are not kept: a
learning that was interrupted is continued, not repeated.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, final

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from safetensors import SafetensorError
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn

from nsde_torch.errors import CheckpointError, NonFiniteError
from nsde_torch.policy.actor import Actor
from nsde_torch.policy.environment import BatchEnvironment
from nsde_torch.policy.options import PolicyOptions
from nsde_torch.whole_files import read_tensors, write_tensors

_FORMAT = "nsde_torch/ppo/1"
_NEVER = 10**9  # updates between stable-baselines3's own tables
_BOUND = 1e3  # of what a policy may see: any numbers that `BatchEnvironment` lets through


@final
class PolicyVecEnv(VecEnv):
    """All machines of a batch environment as one that stable-baselines3 steps, observations over their scale.

    `reward_scale` is a factor on the rewards that the learner sees; `infos[...]["episode"]["r"]` is without it.
    """

    def __init__(self, environment: BatchEnvironment, *, reward_scale: float = 1.0) -> None:
        self.environment, self.reward_scale, task = environment, reward_scale, environment.task
        self._action, self._scale = torch.zeros(0), torch.tensor(task.observation_scale)
        seen = spaces.Box(-_BOUND, _BOUND, (len(task.observation_names),), np.float32)
        super().__init__(environment.n, seen, spaces.Box(-1.0, 1.0, (len(task.action_names),), np.float32))

    def reset(self) -> NDArray[np.float32]:
        """Start all episodes; returns what the policy sees (N, no)."""
        return self._seen(self.environment.reset())

    def step_async(self, actions: NDArray[np.float32]) -> None:
        self._action = torch.as_tensor(actions)

    def step_wait(self) -> tuple[Any, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Advance all machines; an episode that ends is followed by the next at once."""
        made = self.environment.step(self._action)
        done = made.terminated | made.truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in done.nonzero()[:, 0].tolist():
            infos[row] = {
                "terminal_observation": self._seen(made.last[row]),
                "TimeLimit.truncated": bool(made.truncated[row]),
                "episode": {"r": float(made.total[row]), "l": int(made.length[row])},
            }
        rewards = (self.reward_scale * made.reward).float().numpy()
        return self._seen(made.observation), rewards, done.numpy(), infos

    def _seen(self, observation: Tensor) -> NDArray[np.float32]:
        return np.asarray(observation / self._scale)

    # what the class asks for beside: no machine has anything of its own

    def close(self) -> None:
        pass

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        value = None if attr_name == "render_mode" else getattr(self, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        result = getattr(self, method_name)(*args, **kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]


@final
class Learner:
    """A policy in the making. Making one seeds torch's, numpy's and Python's global sources of randomness."""

    def __init__(self, environment: BatchEnvironment, *, options: PolicyOptions, seed: int) -> None:
        self.environment, self.options, self._seed = environment, options, seed
        self._task = environment.task
        start, end = options.lr, options.lr_end
        self._ppo = PPO(
            "MlpPolicy",
            PolicyVecEnv(environment, reward_scale=options.reward_scale),
            learning_rate=lambda left: end + (start - end) * left,
            n_steps=options.rollout,
            batch_size=options.batch,
            n_epochs=options.epochs,
            gamma=options.gamma,
            gae_lambda=options.gae_lambda,
            clip_range=options.clip,
            ent_coef=options.entropy,
            seed=seed,
            device="cpu",
            policy_kwargs={
                "net_arch": {k: list(options.hidden) for k in ("pi", "vf")},
                "activation_fn": nn.Tanh,
            },
        )
        # its own logger would leave an empty folder with the temporary files for every learning
        self._ppo.set_logger(Logger(folder=None, output_formats=[]))

    @property
    def interactions(self) -> int:
        """Steps of the environment so far."""
        return int(self._ppo.num_timesteps)

    def actor(self) -> Actor:
        policy, task = self._ppo.policy, self._task
        actor = Actor(task.observation_scale, self.options.hidden, len(task.action_names), system=task.system)
        given = [m for m in policy.mlp_extractor.policy_net if isinstance(m, nn.Linear)]
        with torch.no_grad():
            for own, theirs in zip(actor.layers, [*given, policy.action_net], strict=True):
                assert isinstance(own, nn.Linear)
                assert isinstance(theirs, nn.Linear)
                own.weight.copy_(theirs.weight)
                own.bias.copy_(theirs.bias)
            actor.log_std.copy_(policy.log_std)
        return actor.eval().requires_grad_(False)

    def learn(self, between_updates: Callable[[], None], *, at_every_step: Callable[[int], object]) -> None:
        """Learn until all interactions are done.

        `between_updates` is called before the first update and after each, the last included, `at_every_step` with the
        number of interactions so far. NonFiniteError: the weights of the policy are not finite.
        """
        left = self.options.interactions - self.interactions
        if left <= 0:
            between_updates()
            return

        def between() -> None:
            if not all(bool(torch.isfinite(p).all()) for p in self._ppo.policy.parameters()):
                raise NonFiniteError(
                    f"the policy left the finite numbers after {self.interactions} interactions. "
                    "A smaller ppo.lr or ppo.reward_scale may help."
                )
            self._ppo.policy.set_training_mode(False)
            between_updates()

        self._ppo.learn(
            left, callback=_Calls(between, at_every_step), log_interval=_NEVER, reset_num_timesteps=False
        )
        between()

    def save(self, path: Path, about: Mapping[str, Any]) -> None:
        """Write a checkpoint; `about` (plain values) travels in its header."""
        tensors = {f"policy.{k}": v for k, v in self._ppo.policy.state_dict().items()}
        for index, moments in self._ppo.policy.optimizer.state_dict()["state"].items():
            tensors |= {f"adam.{index}.{name}": torch.as_tensor(value) for name, value in moments.items()}
        header = {"interactions": self.interactions, "updates": self._ppo._n_updates, **about}
        write_tensors(path, tensors, {"format": _FORMAT, "about": json.dumps(header)})

    def restore(self, path: Path) -> dict[str, Any]:
        """Go on from a checkpoint that `save` wrote; returns what was saved beside the tensors.

        CheckpointError: the file is damaged, or of another network.
        """
        try:
            tensors, metadata = read_tensors(path)
            about: dict[str, Any] = json.loads(metadata["about"])
            policy = {k[7:]: v for k, v in tensors.items() if k.startswith("policy.")}
            adam: dict[int, dict[str, Tensor]] = {}
            for key, value in tensors.items():
                if key.startswith("adam."):
                    _, index, name = key.split(".")
                    adam.setdefault(int(index), {})[name] = value
            self._ppo.policy.load_state_dict(policy)
            state = self._ppo.policy.optimizer.state_dict()
            self._ppo.policy.optimizer.load_state_dict({**state, "state": adam})
            self._ppo.num_timesteps, self._ppo._n_updates = about.pop("interactions"), about.pop("updates")
            # else the actions of the first start would be drawn once more
            self._ppo.set_random_seed(self._seed + self._ppo._n_updates)
        except (SafetensorError, OSError, LookupError, TypeError, ValueError, RuntimeError) as error:
            raise CheckpointError(
                f"checkpoint {path} is damaged or of another configuration ({error}). Remove it to start again."
            ) from error
        return about


class _Calls(BaseCallback):
    """Passes on when an update is about to be collected, and every step."""

    def __init__(self, between: Callable[[], None], at_every_step: Callable[[int], object]) -> None:
        super().__init__()
        self._between, self._at_every_step = between, at_every_step

    def _on_rollout_start(self) -> None:
        self._between()

    def _on_step(self) -> bool:
        self._at_every_step(self.num_timesteps)
        return True
