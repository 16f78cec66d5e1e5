"""Parameters of largest posterior density at given noise levels: of many logs side by side, each with its own prior.

    - log p(theta | y) = - log p(y | theta) + (theta - centre)' K (theta - centre) / 2 + constant

Experiments that are planned and rehearsed are short and hundreds at a time. One pass of the filter takes them all, each
stretch with parameters of its own, so that a step of Gauss and Newton costs what it costs for one long log.
"""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import final

import numpy as np
import torch

from nsde_torch.arrays import Array
from nsde_torch.data import Run
from nsde_torch.effects import Port
from nsde_torch.inference.estimate import LogLikelihood
from nsde_torch.inference.filtering import linearised_about
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.sensitivity import bounded_step, grams
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector

_ROUNDS = 8
_SETTLED = 0.002  # nats that a step promises: `design` calls two fits one equation below 0.05
_SHORTEST = 0.01  # of a step that made the density less
_PASSES = 3  # until the states that a filter is linearised about have settled
_AGAIN = 2  # the same from the states of values close by
_ROWS = 60_000  # that are worked on at once: further ones only take memory


@dataclass(frozen=True)
class LogWithPrior:
    """A log whose parameters are looked for."""

    runs: tuple[Run, ...]  # recordings, all on one step
    centre: Array  # where the prior says that the parameters are (k,)
    information: Array  # how surely (k, k)


@dataclass(frozen=True)
class Posterior:
    """A posterior density about some parameters."""

    theta: Array  # the parameters (k,)
    nats: float  # log likelihood with the quadratic of the prior [nats]
    slope: Array  # of that in the parameters (k,)
    information: Array  # of the log and of the prior (k, k)
    half_square: float  # half the sum of squares of whitened innovations [nats]
    excess: float  # mean square of these: 1 where noise is what it was taken for
    moved: float  # how far the parameters are from the prior's [standard errors of these]

    @property
    def standard_errors(self) -> Array:
        """Of the parameters (k,)."""
        return np.asarray(np.sqrt(np.diag(np.linalg.inv(self.information)).clip(0.0)))


@final
@dataclass(eq=False)
class Posteriors:
    """Posterior densities of one machine at given noise levels."""

    system: System
    levels: Levels
    _: KW_ONLY
    clock: float = 1.0  # physical seconds per logged second
    disturbances: tuple[tuple[Port, int], ...] | None = None
    """Ports that these are levels of, and their columns; None takes those that a log distinguishes."""

    def __post_init__(self) -> None:
        self.vector = ParameterVector(self.system)  # its parameters, whose bounds hold

    def likelihood(self, runs: Sequence[Run], run_in: bool) -> LogLikelihood:
        """The likelihood of some runs; `run_in` as for `modes`."""
        return LogLikelihood(
            *(self.system, runs, self.clock), run_in=run_in, states=True, disturbances=self.disturbances
        )

    def at_centres(self, problems: Sequence[LogWithPrior], *, passes: int = _PASSES) -> list[Posterior]:
        """The densities about the centres of the priors.

        No `passes` of the filter about the states that it found where these are known to be the measured ones.
        """
        out: list[Posterior] = []
        for part in _batches(problems):
            batch = _Batch(self, problems[part], False)
            batch.passes = passes
            out += batch.at(np.stack([q.centre for q in problems[part]]))
        return out

    def cross_information(self, log: LogWithPrior, other: System, run_in: bool) -> Array:
        """Shared information of a log, about its centre, on parameters here and of another machine (k, k_other)."""
        of = self.likelihood(log.runs, run_in)
        beside = of.of(other, of.space.estimates).space
        of.space.use(log.centre)
        beside.use(beside.vector.start)
        about = linearised_about(of.space, of.space.states(of.space.chunks.y), of.start)
        about, at = of.settled(self.levels, about, of.filtered(self.levels, about), _PASSES)
        k, theirs = len(self.vector), len(beside.vector)
        own = of.space.columns(about.x, about.slopes, range(k), about.after)
        columns = torch.cat((own, beside.columns(about.x, about.slopes, range(theirs))), -1)
        gram = grams(of.space, self.levels, about, at, columns).total
        return np.asarray(gram[1 : 1 + k, 1 + k :])

    def modes(
        self,
        problems: Sequence[LogWithPrior],
        *,
        starts: Sequence[Array] | None = None,
        rounds: int = _ROUNDS,
        run_in: bool = False,
    ) -> list[Posterior]:
        """Where the densities are largest, by damped steps of Gauss and Newton.

        Args:
            starts: Parameters of each to begin with (k,); None: the centres.
            rounds: Largest number of steps.
            run_in: Whether the first rows of each stretch only bring up memory (`LogLikelihood`).
        """
        out: list[Posterior] = []
        for part in _batches(problems):
            begun = [q.centre for q in problems[part]] if starts is None else starts[part]
            theta = np.stack([self.vector.inside(start) for start in begun])
            out += self._modes(_Batch(self, problems[part], run_in), theta, rounds)
        return out

    def _modes(self, batch: "_Batch", theta: Array, rounds: int) -> list[Posterior]:
        best = batch.at(theta)
        share, done = np.ones(len(theta)), np.zeros(len(theta), dtype=bool)
        for _ in range(rounds):
            for i, here in enumerate(best):
                step = self.step(here)
                done[i] |= 0.5 * float(step @ here.information @ step) < _SETTLED or share[i] < _SHORTEST
                theta[i] = here.theta if done[i] else self.vector.inside(here.theta + share[i] * step)
            if done.all():
                break
            for i, there in enumerate(batch.at(theta)):
                if done[i]:
                    continue
                if there.nats >= best[i].nats - 1e-9:
                    best[i], share[i] = there, 1.0
                else:  # too far
                    share[i] *= 0.3
        return best

    def left_by_refit(self, here: Posterior) -> float:
        """Half the square of the innovations after a step, with the price that the prior asks for it [nats]."""
        step = self.step(here)
        return here.half_square - float(here.slope @ step - 0.5 * step @ here.information @ step)

    def step(self, here: Posterior) -> Array:
        """Step of Gauss and Newton (k,) between the bounds; a parameter without information stays where it is."""
        low, high = (end - here.theta for end in self.vector.reach(here.theta))
        return bounded_step(here.information, here.slope, 0.0, low, high)


def _batches(problems: Sequence[LogWithPrior]) -> list[slice]:
    """Problems that are worked on at once."""
    ends, rows = [0], 0
    for i, problem in enumerate(problems):
        own = sum(len(run) for run in problem.runs)
        if rows and rows + own > _ROWS:
            ends.append(i)
            rows = 0
        rows += own
    return [slice(a, b) for a, b in zip(ends, [*ends[1:], len(problems)], strict=True)]


@final
class _Batch:
    """Some problems, whose stretches the filter takes side by side."""

    def __init__(self, of: Posteriors, problems: Sequence[LogWithPrior], run_in: bool) -> None:
        self._problems, self._k = problems, len(of.vector)
        runs = [run for q in problems for run in q.runs]
        self._of = of.likelihood(runs, run_in)
        self._levels = of.levels
        owner = torch.tensor([i for i, q in enumerate(problems) for _ in q.runs])
        self._stretch = owner[torch.tensor(self._of.space.steps.runs)]
        self._chunk = self._stretch[self._of.space.chunks.stretch]
        self._block = owner.numpy()[self._of.space.chunks.places()[0]]
        self._x: torch.Tensor | None = None
        self.passes = _PASSES

    @torch.no_grad()
    def at(self, theta: Array) -> list[Posterior]:
        """The densities about parameters (P, k)."""
        space, chunks = self._of.space, self._of.space.chunks
        space.use(theta[self._stretch.numpy()])
        before = space.states(chunks.y) if self._x is None else self._x
        about = linearised_about(space, before, self._of.start)
        at = self._of.filtered(self._levels, about)
        about, at = self._of.settled(self._levels, about, at, self.passes)
        self._x, self.passes = torch.where(torch.isfinite(about.x), about.x, before), _AGAIN
        columns = space.columns(about.x, about.slopes, range(self._k), about.after)
        blocks = grams(space, self._levels, about, at, columns).blocks
        count = len(self._problems)
        whole = np.zeros((count, *blocks.shape[1:]))
        np.add.at(whole, self._block, blocks)
        rows, nats = np.zeros(count), np.zeros(count)
        np.add.at(rows, self._chunk.numpy(), chunks.counted.sum(0).numpy() * len(space.observed))
        np.add.at(nats, self._chunk.numpy(), at.rows.sum(0).numpy())
        out = []
        for q, here, own, n, gram in zip(self._problems, theta, nats, rows, whole, strict=True):
            away = here - q.centre
            pull = q.information @ away
            cost = 0.5 * float(away @ pull)
            fine = bool(np.isfinite(own) and np.isfinite(gram).all())
            gram = gram if fine else np.zeros_like(gram)
            density = float(own) - cost if fine else -np.inf
            slope, information, square = gram[1:, 0] - pull, gram[1:, 1:] + q.information, float(gram[0, 0])
            sizes = 0.5 * square, square / max(float(n), 1.0), float(np.sqrt(2.0 * cost))
            out.append(Posterior(here.copy(), density, slope, information, *sizes))
        return out
