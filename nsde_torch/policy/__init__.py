"""Policies: tasks, environments whose step is a true or a learned machine, and learning in them.

`vec_env`, `single_env` and `ppo` need the extra `nsde_torch[policy]` (gymnasium, stable-baselines3) and are
imported by name; everything here does without.
"""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.policy.actor import Actor, load_policy
    from nsde_torch.policy.dynamics import Dynamics
    from nsde_torch.policy.environment import BatchEnvironment, Transition
    from nsde_torch.policy.evaluate import Rewards, episode_rewards, random_policy, score
    from nsde_torch.policy.learned import make_learned
    from nsde_torch.policy.options import PolicyOptions
    from nsde_torch.policy.task import TASKS, Box, CartpoleSwingUp, make_task
    from nsde_torch.policy.training import PolicyTraining
    from nsde_torch.policy.truth import TRUTHS, make_truth

__all__ = [
    "TASKS",
    "TRUTHS",
    "Actor",
    "BatchEnvironment",
    "Box",
    "CartpoleSwingUp",
    "Dynamics",
    "PolicyOptions",
    "PolicyTraining",
    "Rewards",
    "Transition",
    "episode_rewards",
    "load_policy",
    "make_learned",
    "make_task",
    "make_truth",
    "random_policy",
    "score",
]

__getattr__ = resolver(
    __name__,
    {
        "TASKS": "task",
        "TRUTHS": "truth",
        "Actor": "actor",
        "BatchEnvironment": "environment",
        "Box": "task",
        "CartpoleSwingUp": "task",
        "Dynamics": "dynamics",
        "PolicyOptions": "options",
        "PolicyTraining": "training",
        "Rewards": "evaluate",
        "Transition": "environment",
        "episode_rewards": "evaluate",
        "load_policy": "actor",
        "make_learned": "learned",
        "make_task": "task",
        "make_truth": "truth",
        "random_policy": "evaluate",
        "score": "evaluate",
    },
)
