"""What a policy is asked to do: swing the pole of a cart up within four seconds, and hold it there.

    r = cos(theta) - 0.01 |x| - |a| - 0.1 |theta'| - 0.1 |x'|,        force = 25 N * a,   a in [-1, 1]

of the true state after the step and of the action that led to it; 200 steps of 0.02 s make an episode, and the
policy sees (x, x', sin theta, cos theta, theta'), measured. Reward, bounds and first states are those of the
environment in the public code that belongs to the supplement (its Figures 13 and 14): episodes for training start
in [-1, -1, pi - 0.8, -0.8] .. [1, 1, pi + 0.8, 0.8], those of the figures in [-0.2, -0.5, 2.8, -0.3] ..
[0.2, 0.5, 3.3, 0.3]. There an episode also ends where the cart leaves 120 m of track. Here it does too, but the
steps that were left are charged what the last one cost, so that leaving never pays; and no step costs more than
25, whatever a learned model makes of a state that no cart can have.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import torch
from torch import Tensor

from nsde_torch.errors import ConfigError

_ABSURD = 1e4
"""No speed [m/s, rad/s] or angle [rad] of four seconds comes near it."""


@dataclass(frozen=True)
class Box:
    """First states, uniform between two corners.

    Args:
        low: Smallest state.
        high: Largest state.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    def draw(self, n: int, generator: torch.Generator) -> Tensor:
        """First states (n, nx), float64."""
        low, high = (torch.tensor(corner, dtype=torch.float64) for corner in (self.low, self.high))
        return low + (high - low) * torch.rand(n, len(low), generator=generator, dtype=torch.float64)


@dataclass(frozen=True)
class CartpoleSwingUp:
    """Swing the pole up and hold it.

    Args:
        steps: Length of an episode [steps].
        training: First states of training.
        evaluation: First states of the supplement's figures.
    """

    steps: int = 200
    training: Box = Box((-1.0, -1.0, pi - 0.8, -0.8), (1.0, 1.0, pi + 0.8, 0.8))
    evaluation: Box = Box((-0.2, -0.5, 2.8, -0.3), (0.2, 0.5, 3.3, 0.3))

    system = "cartpole"
    dt = 0.02
    force = 25.0
    track = 120.0
    lowest = -25.0
    observation_names = ("x", "x_dot", "sin_theta", "cos_theta", "theta_dot")
    observation_scale = (2.0, 3.0, 1.0, 1.0, 6.0)
    action_names = ("force / 25 N",)
    reward_unit = "1 per episode"

    def observe(self, measured: Tensor) -> Tensor:
        """What a policy sees (N, 5) of measured states (N, 4)."""
        theta = measured[:, 2]
        return torch.stack(
            (measured[:, 0], measured[:, 1], torch.sin(theta), torch.cos(theta), measured[:, 3]), 1
        )

    def command(self, action: Tensor) -> Tensor:
        """Force (N, 1) [N] of actions (N, 1); beyond [-1, 1] they are clipped."""
        return self.force * action.clamp(-1.0, 1.0)

    def reward(self, x: Tensor, action: Tensor) -> Tensor:
        """Reward (N,) of the true states (N, 4) after a step with these actions (N, 1)."""
        cost = (
            0.01 * x[:, 0].abs() + 0.1 * (x[:, 1].abs() + x[:, 3].abs()) + action[:, 0].clamp(-1.0, 1.0).abs()
        )
        return torch.nan_to_num(torch.cos(x[:, 2]) - cost, nan=self.lowest).clamp_min(self.lowest)

    def left(self, x: Tensor) -> Tensor:
        """Rows (N,) whose true states (N, 4) are off the track, or none that a cart can have."""
        return ~(x.abs() < _ABSURD).all(1) | (x[:, 0].abs() > self.track)


TASKS: dict[str, type[CartpoleSwingUp]] = {"cartpole": CartpoleSwingUp}
"""System -> what a policy is asked to do with it."""


def make_task(system: str) -> CartpoleSwingUp:
    """The task of a system.

    Raises:
        ConfigError: there is none.
    """
    if system not in TASKS:
        raise ConfigError(f"`system` must be one that has a task: {', '.join(TASKS)}; got {system!r}.")
    return TASKS[system]()
