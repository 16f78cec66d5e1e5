"""Many episodes at once: a task on a batch of machines, where an episode that ends makes room for the next.

    x_{k+1} = dynamics(x_k, command(a_k)),   o_k = observe(measured x_k),   r_k = reward(x_{k+1}, a_k)

The dynamics are true or learned; reward and end of an episode are those of the task, of the state without sensor
noise. An episode that has had all its steps is cut off (`truncated`); one that has left the track, or the finite
numbers, is over (`terminated`) and pays its last reward for every step that was left.
"""

from dataclasses import KW_ONLY, dataclass
from math import pi
from typing import Protocol, final

import torch
from torch import Tensor

from nsde_torch.errors import ConfigError, ShapeError

# What a policy is asked to do: swing up the pole of a cart within four seconds, and hold it there.
#
#     r = cos(theta) - 0.01 |x| - |a| - 0.1 |theta'| - 0.1 |x'|,        force = 25 N * a,   a in [-1, 1]
#
# of the true state after the step and of the action that led to it; 200 steps of 0.02 s make an episode, and
# the policy sees (x, x', sin theta, cos theta, theta'), measured. Reward, bounds and first states are those
# of the environment in the public code that belongs to the supplement (its Figures 13 and 14): episodes for
# training start in [-1, -1, pi - 0.8, -0.8] .. [1, 1, pi + 0.8, 0.8], those of the figures in [-0.2, -0.5,
# 2.8, -0.3] .. [0.2, 0.5, 3.3, 0.3]. There an episode also ends where the cart leaves 120 m of track. Here it
# does too, but the steps that were left are charged what the last one cost, so that leaving never pays; and
# no step costs more than 25, whatever a learned model makes of a state that no cart can have.


class Dynamics(Protocol):
    """A batch of machines. What a path carries beside its state (memory, disturbance) stays in here."""

    @property
    def state(self) -> Tensor:
        """True states (N, nx), whatever the sensors say."""

    def reset(self, x0: Tensor) -> Tensor:
        """Start N machines at rest in the states (N, nx); returns them as measured."""

    def restart(self, rows: Tensor, x0: Tensor) -> Tensor:
        """Start some of the machines (K,) anew in the states (K, nx); returns these as measured."""

    def step(self, u: Tensor) -> Tensor:
        """Advance all machines by one sample under the inputs (N, nu), which act as given; returns measured states."""


_ABSURD = 1e4  # no speed [m/s, rad/s] or angle [rad] of four seconds comes near it


@dataclass(frozen=True)
class Box:
    """First states, uniform between two corners."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    def draw(self, n: int, generator: torch.Generator) -> Tensor:
        """First states (n, nx), float64."""
        low, high = (torch.tensor(corner, dtype=torch.float64) for corner in (self.low, self.high))
        return low + (high - low) * torch.rand(n, len(low), generator=generator, dtype=torch.float64)


@dataclass(frozen=True)
class CartpoleSwingUp:
    """Swing the pole up and hold it, in episodes of some steps; evaluations start as the supplement's figures do."""

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
    """The task of a system. ConfigError: there is none."""
    if system not in TASKS:
        raise ConfigError(f"`system` must be one that has a task: {', '.join(TASKS)}; got {system!r}.")
    return TASKS[system]()


_LARGEST = 1e3
"""Observations beyond this come only from episodes that are over; they are cut so that no network sees them."""


@dataclass(frozen=True)
class Transition:
    """What one step of all machines gives."""

    observation: Tensor  # what the policy sees next (N, no), float32; of a machine that starts anew its first
    reward: Tensor  # of the step (N,)
    terminated: Tensor  # rows whose episode is over for good
    truncated: Tensor  # rows whose episode has had all its steps
    last: Tensor  # what it saw at the end of an episode (N, no), float32; of others, as `observation`
    total: Tensor  # sum of the rewards of the episode so far, the ended one included (N,)
    length: Tensor  # steps of the episode so far (N,)


@final
@dataclass(eq=False)
class BatchEnvironment:
    """A task on N machines.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> environment = BatchEnvironment(task, dynamics, n=1024, generator=generator, start=task.training)
        >>> observation = environment.reset()
        >>> step = environment.step(policy(observation))
    """

    task: CartpoleSwingUp  # what is asked for
    dynamics: Dynamics  # the machines
    _: KW_ONLY
    n: int  # number of machines, >= 1
    generator: torch.Generator  # source of the first states
    start: Box  # where episodes start
    stagger: bool = False
    """Begin with episodes of unequal length, so that the machines are not all at the same moment from then on."""

    def __post_init__(self) -> None:
        self._length = torch.zeros(self.n, dtype=torch.long)
        self._limit = torch.full((self.n,), self.task.steps)
        self._total = torch.zeros(self.n, dtype=torch.float64)

    def reset(self) -> Tensor:
        """Start all episodes; what the policy sees (N, no), float32."""
        x = self.start.draw(self.n, self.generator)
        self._length, self._total = torch.zeros_like(self._length), torch.zeros_like(self._total)
        self._limit = torch.full((self.n,), self.task.steps)
        if self.stagger:
            self._limit = torch.randint(1, self.task.steps + 1, (self.n,), generator=self.generator)
        return self._seen(self.dynamics.reset(x))

    @torch.no_grad()
    def step(self, action: Tensor) -> Transition:
        """Advance all episodes by one step under actions (N, na); what lies beyond the bounds is clipped.

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
        fresh = self.dynamics.restart(rows, self.start.draw(len(rows), self.generator))
        self._length = self._length.masked_fill(ended, 0)
        self._limit = self._limit.masked_fill(ended, self.task.steps)
        self._total = self._total.masked_fill(ended, 0.0)
        return seen.index_copy(0, rows, self._seen(fresh))

    def _seen(self, measured: Tensor) -> Tensor:
        seen = torch.nan_to_num(self.task.observe(measured).float(), nan=0.0)
        return seen.clamp(-_LARGEST, _LARGEST)
