"""Settings of learning a policy."""

from __future__ import annotations

from dataclasses import dataclass

from nsde_torch.errors import ConfigError


@dataclass(frozen=True)
class PolicyOptions:
    """Settings of proximal policy optimisation (Schulman et al. 2017) as stable-baselines3 does it.

    Args:
        interactions: Steps of the environment in all, all machines counted.
        n_envs: Machines in the batch.
        rollout: Steps of each machine between updates.
        batch: Steps in a gradient step; divides n_envs times rollout.
        epochs: Passes over the steps of an update.
        lr: Adam's learning rate at the start.
        lr_end: Learning rate at the end; it falls linearly.
        gamma: Discount of the future, per step.
        gae_lambda: Weight of long advantages.
        clip: How far the ratio of new to old probabilities may leave 1.
        entropy: Weight of the reward on broad actions.
        hidden: Widths of the networks of policy and value (tanh).
        reward_scale: Factor on the rewards that the learner sees; keeps the values near 1.
        evaluate_every: Interactions between evaluations.
        episodes: Episodes of an evaluation.
        final_episodes: Episodes of the last one.
    """

    interactions: int = 600_000
    n_envs: int = 32
    rollout: int = 200
    batch: int = 640
    epochs: int = 10
    lr: float = 1e-3
    lr_end: float = 1e-5
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy: float = 0.0
    hidden: tuple[int, ...] = (64, 64)
    reward_scale: float = 0.1
    evaluate_every: int = 20_000
    episodes: int = 200
    final_episodes: int = 1000

    def __post_init__(self) -> None:
        if self.n_envs * self.rollout % self.batch:
            raise ConfigError(
                f"`ppo.batch` must divide the {self.n_envs * self.rollout} steps between updates "
                f"(ppo.n_envs={self.n_envs} times ppo.rollout={self.rollout}); got {self.batch}."
            )
        if self.batch < 2:
            raise ConfigError(
                f"`ppo.batch` must be at least 2 (advantages are standardised); got {self.batch}."
            )
