"""Residuals of a spring that are made: white innovations, and what a push does to them."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray

from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.joint_selection import FittedPhysics
from nsde_torch.diagnosis.regressors import Measured, measured
from nsde_torch.diagnosis.residual_tests import PhysicsResiduals
from nsde_torch.diagnosis.search import Search
from nsde_torch.inference import LogLikelihood, Optimum, nearly_maximised
from nsde_torch.inference.estimate import Latest
from nsde_torch.inference.filtering import Pass, forced, with_gains
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import recorded

Array = NDArray[np.float64]


def with_own_pass(of: LogLikelihood) -> LogLikelihood:
    """The same likelihood, which keeps the pass of another optimum."""
    other = copy.copy(of)
    other.passes, other.scores = Latest(), Latest()
    return other


Push = Callable[[Array, Array, Array, Array], Array]
"""Of positions, speeds, times in the run and numbers of the run, each (N,) [m/s2]."""

SPRING = "mass_spring_damper"


class MadeResiduals:
    """A spring that lacks nothing, fitted, whose innovations are drawn anew."""

    def __init__(self, durations: Sequence[float] = (8.0,) * 4, dt: float = 0.02) -> None:
        system = make_system(SPRING)
        self.data = recorded(SPRING, durations=durations, dt=dt)
        self.search: Search = Search(system, self.data.runs, 1.0, Options())
        best, at = nearly_maximised(LogLikelihood(system, self.data.runs, 1.0, run_in=True))
        self.place = FittedPhysics(system, best, at)
        self.regression: Regression = self.search.at(self.place)
        self.measured: Measured = measured(self.regression, inputs=True)

    def made(self, push: Push | None = None, seed: int | None = 0) -> PhysicsResiduals:
        """What is left, with a push; without a seed the innovations are those of the data."""
        at = self.place.at
        space, about, here = at.of.space, at.about, at.at
        white = here.white.clone()
        if seed is not None:
            white = torch.from_numpy(np.random.default_rng([seed, 7]).normal(size=tuple(white.shape)))
        run = np.array(space.steps.runs)[space.chunks.stretch.numpy()]
        if push is not None:
            white += self._moved(push, here, run)
        drawn = Optimum(with_own_pass(at.of), at.levels, about, replace(here, white=white), at.free)
        return PhysicsResiduals(self.search, replace(self.place, at=drawn), self._regression(push))

    def _moved(self, push: Push, here: Pass, run: NDArray[np.int64]) -> torch.Tensor:
        """What a push does to the whitened innovations."""
        at = self.place.at
        space, about = at.of.space, at.about
        middle = space.midway(about.x, about.after).numpy()
        t = space.chunks.t.numpy()
        force = push(middle[..., 0], middle[..., 1], t, np.broadcast_to(run, t.shape))
        steps = -forced(space, about, 0, torch.from_numpy(np.ascontiguousarray(force)))
        none = {"seen": torch.zeros_like(about.seen), "first": torch.zeros_like(about.first)}
        alone = replace(about, missed=steps, **none)
        moved = with_gains(space, at.levels, alone, here.whitening, here.gain, space.chunks.counted)
        return moved.white

    def _regression(self, push: Push | None) -> Regression:
        """The regression with the push in its residual."""
        if push is None:
            return self.regression
        r, seen = self.regression.under(0, self.regression.noises[0]), self.measured
        force = push(seen.columns["q"], seen.columns["q_dot"], seen.t, r.owners)
        r.residual = r.residual.copy()
        r.residual[:, r.rows[0]] += force * r.dt
        return r


@cache
def made_residuals(runs: int = 4) -> MadeResiduals:
    """Those of so many runs of 8 s."""
    return MadeResiduals((8.0,) * runs)
