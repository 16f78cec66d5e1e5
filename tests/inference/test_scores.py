"""Scores of parameters, noise levels and forces against differences of the likelihood itself."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.stats import chi2

from nsde_torch.inference import (
    LogLikelihood,
    MaximumLikelihood,
    Optimum,
    nearly_maximised,
)
from nsde_torch.inference.estimate import Latest
from nsde_torch.inference.filtering import Linearisation, Pass, filtered, with_gains
from nsde_torch.inference.force_scores import force_scores
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.maximum import level_slopes, score
from nsde_torch.inference.sensitivity import grams
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import recorded
from tests.inference.springs import levels_of, linear_runs, spring

Array = NDArray[np.float64]


def test_at_the_truth_the_gram_score_has_no_mean_and_the_gram_matrix_as_its_covariance() -> None:
    levels, system, squares, scores = levels_of(), spring(), [], []
    for seed in range(40):
        problem = LogLikelihood(system, linear_runs(1, 3.0, seed=seed))
        _, about = problem.first(problem.vector.start)
        at = problem.filtered(levels, about)
        columns = problem.space.columns(about.x, about.slopes, range(3))
        gram = grams(problem.space, levels, about, at, columns).total
        white = np.linalg.solve(np.linalg.cholesky(gram[1:, 1:]), gram[1:, 0])
        scores.append(white)
        squares.append(float(white @ white))
    low, high = chi2.ppf((0.005, 0.995), 3 * len(squares))
    assert low < sum(squares) < high
    assert (np.abs(np.mean(scores, 0)) < 3.0 / np.sqrt(len(scores))).all()


Fitted = tuple[MaximumLikelihood, Optimum]


@pytest.fixture(scope="module", params=["mass_spring_damper", "cartpole"])
def fitted(request: pytest.FixtureRequest) -> Fitted:
    data = recorded(request.param, durations=(3.0,) * 3)
    return nearly_maximised(LogLikelihood(make_system(request.param), data.runs, run_in=True))


def test_the_score_of_a_force_is_the_slope_of_the_log_likelihood(fitted: Fitted) -> None:
    best, at = fitted
    alone = np.zeros(0, dtype=np.int64)  # no parameters beside them
    other = copy.copy(at.of)
    other.passes, other.scores = Latest(), Latest()  # of another optimum
    found = force_scores(Optimum(other, at.levels, at.about, at.at, alone))
    space = at.of.space
    space.use(best.theta)
    acts = space.pushed(at.about.x, at.about.slopes, at.about.after)
    here = filtered(space, at.levels, at.about, space.chunks.counted)
    rng = np.random.default_rng(0)
    for port in range(space.nd):
        # a force on a step is one in all chunks that hold it
        step = int(rng.integers(20, len(space.steps) - 20))
        change = 1e-4 / max(float(acts[..., port].abs().max()), 1e-12)
        moved = change * (space.chunks.row == step)[..., None] * acts[..., port]

        def total(moved: torch.Tensor) -> float:
            there = replace(at.about, missed=at.about.missed + moved)
            return with_gains(space, at.levels, there, here.whitening, here.gain, space.chunks.counted).total

        slope = (total(moved) - total(-moved)) / (2.0 * change)
        along = found.along(port, len(space.steps))[0]
        assert along[step] == pytest.approx(slope, rel=1e-4, abs=1e-6 * abs(along).max())


SMALL = 1e-5


def problem_of(name: str) -> LogLikelihood:
    if name == "flight":
        made = recorded("hexacopter", "motor_lag", durations=(3.0,), seed=3, plant={"rounds": 1})
        return LogLikelihood(make_system("hexacopter", effects=["motor_lag"]), made.runs)
    # rounding grew from row to row of the pass backwards: slopes of 1e50 and more, and levels that never moved
    precise = {"sensor": (1e-6, 1e-6)} if name == "precise" else {}
    return LogLikelihood(spring(), linear_runs(2, 12.0 if precise else 4.0, **precise))


def passed(problem: LogLikelihood, levels: Levels, about: Linearisation) -> Pass:
    live = problem.space.chunks.counted
    return filtered(problem.space, levels, about, live, covariances=problem.space.nd)


@pytest.mark.parametrize("of", ["spring", "flight", "precise"])
def test_the_score_and_the_slopes_of_the_levels_are_the_filter_s(of: str) -> None:
    problem = problem_of(of)
    first, about = problem.first(problem.vector.start)
    phi, live = first.vector(), problem.space.chunks.counted
    at = passed(problem, first, about)
    exact = score(problem.space, first, about, at, live).sum(0)
    slopes, spreads = level_slopes(problem.space, first, about, at, spreads=True)
    for j, step in enumerate(SMALL * torch.eye(len(phi), dtype=phi.dtype)):
        up, down = (passed(problem, first.like(phi + way * step), about) for way in (1.0, -1.0))
        difference = (up.total - down.total) / (2 * SMALL)
        assert exact[j] == pytest.approx(difference, rel=1e-4, abs=1e-6 * float(exact.abs().max()))
        moved = at.whitening @ (up.errors - down.errors)[..., None] / (2 * SMALL)
        near = 2e-5 * float(slopes.abs().max())
        np.testing.assert_allclose(slopes[..., j], moved[..., 0], atol=near)
        seen = [torch.linalg.inv(p.whitening) for p in (up, down)]
        turned = (seen[0] @ seen[0].mT - seen[1] @ seen[1].mT) / (2 * SMALL)
        turned = at.whitening @ turned @ at.whitening.mT
        np.testing.assert_allclose(spreads[1:, :, j], turned[1:], atol=1e-5)
