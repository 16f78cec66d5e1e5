"""Policies: tasks, environments whose step is a true or a learned machine, and learning in them.

`ppo`, imported by name, needs the extra `nsde_torch[policy]` (gymnasium, stable-baselines3); all else does without.
"""

from typing import TYPE_CHECKING

from nsde_torch.lazy import names, resolver

if TYPE_CHECKING:
    from nsde_torch.policy.actor import Actor, load_policy
    from nsde_torch.policy.environment import (
        TASKS,
        BatchEnvironment,
        Box,
        CartpoleSwingUp,
        Dynamics,
        Transition,
        make_task,
    )
    from nsde_torch.policy.learned import TRUTHS, make_learned, make_truth
    from nsde_torch.policy.options import PolicyOptions
    from nsde_torch.policy.training import PolicyTraining, Rewards, episode_rewards, random_policy, score

__all__ = names(__name__)
__getattr__ = resolver(__name__)
