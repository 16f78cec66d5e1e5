"""Settings of learning a policy."""

from __future__ import annotations

from dataclasses import dataclass

from nsde_torch.errors import ConfigError
from nsde_torch.options import check, documented, key


@documented
@dataclass(frozen=True)
class PolicyOptions:
    """Proximal policy optimisation (Schulman et al. 2017) as stable-baselines3 does it."""

    interactions: int = key(600_000, "interactions with the environment", low=1)
    n_envs: int = key(32, "machines in the batch", low=1)
    rollout: int = key(200, "steps of each machine between updates", unit="steps", low=1)
    batch: int = key(640, "steps in a gradient step; divides ppo.n_envs times ppo.rollout", low=2)
    epochs: int = key(10, "passes over the steps of an update", low=1)
    lr: float = key(0.001, "learning rate at the start", above=0)
    lr_end: float = key(0.00001, "learning rate at the end; it falls linearly", above=0)
    gamma: float = key(0.99, "discount of the future, per step", above=0, high=1)
    gae_lambda: float = key(0.95, "weight of long advantages", low=0, high=1)
    clip: float = key(0.2, "how far the ratio of new to old probabilities may leave 1", above=0)
    entropy: float = key(0.0, "weight of the reward on broad actions", low=0)
    hidden: tuple[int, ...] = key((64, 64), "widths of the networks of policy and value (tanh)", low=1)
    reward_scale: float = key(0.1, "factor on the rewards that the learner sees", above=0)
    evaluate_every: int = key(20_000, "interactions between evaluations and checkpoints", low=1)
    episodes: int = key(200, "episodes of an evaluation", low=1)
    final_episodes: int = key(1000, "episodes of the last evaluation", low=1)

    def __post_init__(self) -> None:
        if self.n_envs * self.rollout % self.batch:
            raise ConfigError(
                f"`ppo.batch` must divide the {self.n_envs * self.rollout} steps between updates "
                f"(ppo.n_envs={self.n_envs} times ppo.rollout={self.rollout}); got {self.batch}."
            )
        check(type(self), vars(self), "ppo.")
