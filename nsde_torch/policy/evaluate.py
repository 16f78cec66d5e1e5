"""What a policy is worth: rewards of whole episodes, and the score that compares environments.

    score = (R - R_random) / (R_truth - R_random)

R is the mean reward per episode on the true dynamics, R_random that of actions uniform in [-1, 1], and R_truth that
of policies trained on the truth: 0 is a policy that has learned nothing, 1 one that had the real machine.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from nsde_torch.policy.environment import BatchEnvironment

Policy = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Rewards:
    """Rewards of episodes.

    Args:
        mean: Mean over episodes.
        std: Standard deviation over episodes.
        worst: Smallest.
        episodes: How many.
        left: Episodes that left the track or the finite numbers.
    """

    mean: float
    std: float
    worst: float
    episodes: int
    left: int


@torch.no_grad()
def episode_rewards(policy: Policy, environment: BatchEnvironment) -> Rewards:
    """Play one whole episode on every machine of an environment.

    Args:
        policy: Actions (N, na) from what is seen (N, no).
        environment: The machines; not staggered.
    """
    seen = environment.reset()
    total = torch.full((environment.n,), torch.nan, dtype=torch.float64)
    left = torch.zeros(environment.n, dtype=torch.bool)
    for _ in range(environment.task.steps):
        made = environment.step(policy(seen))
        first = (made.terminated | made.truncated) & torch.isnan(total)
        total = torch.where(first, made.total, total)
        left |= first & made.terminated
        seen = made.observation
    return Rewards(
        float(total.mean()),
        float(total.std(correction=0)),
        float(total.min()),
        environment.n,
        int(left.sum()),
    )


def random_policy(environment: BatchEnvironment, generator: torch.Generator) -> Policy:
    """Actions uniform in [-1, 1], whatever is seen."""
    shape = (environment.n, len(environment.task.action_names))
    return lambda _: 2.0 * torch.rand(*shape, generator=generator) - 1.0


def score(reward: float, *, random: float, truth: float) -> float | None:
    """The score; None where the policy trained on the truth is no better than chance."""
    return (reward - random) / (truth - random) if truth > random else None
