"""Many episodes at once: a task on a batch of machines, where an episode that ends makes room for the next.

    x_{k+1} = dynamics(x_k, command(a_k)),   o_k = observe(measured x_k),   r_k = reward(x_{k+1}, a_k)

The dynamics are true or learned; reward and end of an episode are those of the task, of the state without sensor
noise. An episode that has had all its steps is cut off (`truncated`); one that has left the track, or the finite
numbers, is over (`terminated`) and pays its last reward for every step that was left.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import torch
from torch import Tensor

from nsde_torch.errors import ConfigError, ShapeError
from nsde_torch.policy.dynamics import Dynamics
from nsde_torch.policy.task import Box, CartpoleSwingUp

_LARGEST = 1e3
"""Observations beyond this come only from episodes that are over; they are cut so that no network sees them."""


@dataclass(frozen=True)
class Transition:
    """What one step of all machines gives.

    Args:
        observation: What the policy sees next (N, no), float32; of a machine that starts anew, its first one.
        reward: Reward of the step (N,).
        terminated: Rows whose episode is over for good.
        truncated: Rows whose episode has had all its steps.
        last: What the policy saw at the end of the episode, for rows that ended (N, no), float32; elsewhere as
            `observation`.
        total: Sum of the rewards of the episode so far, the ended one included (N,).
        length: Steps of the episode so far (N,).
    """

    observation: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    last: Tensor
    total: Tensor
    length: Tensor


@final
class BatchEnvironment:
    """A task on N machines.

    Args:
        task: What is asked for.
        dynamics: The machines.
        n: Number of machines, >= 1.
        generator: Source of the first states.
        start: Where episodes start.
        stagger: Begin with episodes of unequal length, so that the machines are not all at the same moment of
            an episode from then on.

    Raises:
        ConfigError: no machine.

    Example:
        >>> environment = BatchEnvironment(
        ...     task, dynamics, n=1024, generator=torch.Generator().manual_seed(0), start=task.training
        ... )
        >>> observation = environment.reset()
        >>> step = environment.step(policy(observation))
    """

    def __init__(
        self,
        task: CartpoleSwingUp,
        dynamics: Dynamics,
        *,
        n: int,
        generator: torch.Generator,
        start: Box,
        stagger: bool = False,
    ) -> None:
        if n < 1:
            raise ConfigError(f"`n_envs` must be at least 1; got {n!r}.")
        self.task, self.dynamics, self.n = task, dynamics, n
        self._generator, self._start, self._stagger = generator, start, stagger
        self._length = torch.zeros(n, dtype=torch.long)
        self._limit = torch.full((n,), task.steps)
        self._total = torch.zeros(n, dtype=torch.float64)

    def reset(self, x0: Tensor | None = None) -> Tensor:
        """Start all episodes.

        Args:
            x0: First states (N, nx); default: drawn where episodes start.

        Returns:
            What the policy sees (N, no), float32.

        Raises:
            ShapeError: `x0` has another number of rows.
        """
        if x0 is not None and len(x0) != self.n:
            raise ShapeError(f"`x0` must have a row for each of the {self.n} machines; got {len(x0)}.")
        x = self._start.draw(self.n, self._generator) if x0 is None else x0
        self._length, self._total = torch.zeros_like(self._length), torch.zeros_like(self._total)
        self._limit = torch.full((self.n,), self.task.steps)
        if self._stagger:
            self._limit = torch.randint(1, self.task.steps + 1, (self.n,), generator=self._generator)
        return self._seen(self.dynamics.reset(x))

    @torch.no_grad()
    def step(self, action: Tensor) -> Transition:
        """Advance all episodes by one step.

        Args:
            action: Actions (N, na); what lies beyond the bounds is clipped.

        Raises:
            ShapeError: wrong rows or columns.
        """
        task = self.task
        if action.shape != (self.n, len(task.action_names)):
            raise ShapeError(
                f"`action` must be ({self.n}, {len(task.action_names)}); got {tuple(action.shape)}."
            )
        last = self._seen(self.dynamics.step(task.command(action)))
        x = self.dynamics.state
        self._length = self._length + 1
        reward = task.reward(x, action.to(x)).double()
        terminated = task.left(x)
        reward = torch.where(terminated, reward * (1 + self._limit - self._length), reward)
        total, length = self._total + reward, self._length
        truncated = (length >= self._limit) & ~terminated
        self._total = total
        observation = self._begin(terminated | truncated, last)
        return Transition(observation, reward, terminated, truncated, last, total, length)

    def _begin(self, ended: Tensor, seen: Tensor) -> Tensor:
        """New episodes where one has ended; what the policy sees then."""
        rows = ended.nonzero()[:, 0]
        if not len(rows):
            return seen
        fresh = self.dynamics.restart(rows, self._start.draw(len(rows), self._generator))
        self._length = self._length.masked_fill(ended, 0)
        self._limit = self._limit.masked_fill(ended, self.task.steps)
        self._total = self._total.masked_fill(ended, 0.0)
        return seen.index_copy(0, rows, self._seen(fresh))

    def _seen(self, measured: Tensor) -> Tensor:
        seen = torch.nan_to_num(self.task.observe(measured).float(), nan=0.0)
        return seen.clamp(-_LARGEST, _LARGEST)
