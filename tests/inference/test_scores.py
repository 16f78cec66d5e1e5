"""Scores of parameters, noise levels and forces against differences of the likelihood itself."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.stats import chi2

from nsde_torch.data import Run
from nsde_torch.inference import (
    LogLikelihood,
    MaximumLikelihood,
    Optimum,
    kernels,
    log_likelihood,
    nearly_maximised,
)
from nsde_torch.inference.filtering import Linearisation, Pass, filtered, with_gains
from nsde_torch.inference.force_scores import force_scores
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.maximum import level_slopes, score
from nsde_torch.inference.sensitivity import grams
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import recorded
from tests.helpers.residuals import with_own_pass
from tests.inference.springs import SENSOR, K, levels_of, linear_runs, moved, spring

Array = NDArray[np.float64]


def slopes(runs: Sequence[Run], levels: Levels, by: Mapping[str, float]) -> tuple[Array, Array]:
    """Score in standard errors: from the Gram matrix, and by differences of the log likelihood."""
    system = moved(by)
    problem = LogLikelihood(system, runs)
    _, about = problem.first(problem.vector.start)
    about, at = problem.settled(levels, about, problem.filtered(levels, about), 4)
    columns = problem.space.columns(about.x, about.slopes, range(len(problem.vector)))
    gram = grams(problem.space, levels, about, at, columns).total
    error = 1.0 / np.sqrt(np.diag(gram)[1:])
    differences = []
    for label, size in zip(problem.vector.labels, 0.02 * error, strict=True):
        up, down = (
            log_likelihood(moved({**by, label: by.get(label, 0.0) + s}), runs, levels=levels)
            for s in (size, -size)
        )
        differences.append((up - down) / 0.04)
    return gram[1:, 0] * error, np.array(differences)


@pytest.mark.parametrize("inferred", [False, True])
@pytest.mark.parametrize("by", [{}, {K: 2.0}], ids=["truth", "stiffer"])
def test_the_gram_score_is_that_of_the_likelihood_but_for_what_parameters_do_to_the_gains(
    by: dict[str, float], inferred: bool
) -> None:
    runs = linear_runs(2, 4.0)
    if inferred:
        runs = [replace(run, inferred={"q_dot": 0.4}) for run in runs]
    levels = levels_of(SENSOR[:1] if inferred else SENSOR)
    held, true = slopes(runs, levels, by)
    # a gain of the input moves no covariance: there, holding the gains leaves nothing out
    assert held[0] == pytest.approx(true[0], abs=2e-3)
    # the others move them: at the truth by chance alone, a seventh of a standard error here; a little more away from it
    np.testing.assert_allclose(held, true, atol=0.25 if not by else 0.5)
    if by:
        assert held @ true > 0.98 * np.linalg.norm(held) * np.linalg.norm(true)


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
    found = force_scores(Optimum(with_own_pass(at.of), at.levels, at.about, at.at, alone))
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


def flight() -> LogLikelihood:
    system = make_system("hexacopter", effects=["motor_lag"])
    made = recorded("hexacopter", "motor_lag", durations=(3.0,), seed=3, plant={"rounds": 1})
    return LogLikelihood(system, made.runs)


def passed(problem: LogLikelihood, levels: Levels, about: Linearisation) -> Pass:
    live = problem.space.chunks.counted
    return filtered(problem.space, levels, about, live, covariances=problem.space.nd)


@pytest.mark.parametrize("of", ["spring", "flight"])
def test_the_score_and_the_slopes_of_the_levels_are_the_filter_s(of: str) -> None:
    problem = LogLikelihood(spring(), linear_runs(2, 4.0)) if of == "spring" else flight()
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


@pytest.mark.parametrize("precise", [1e-3, 1e-5, 1e-7])
def test_the_score_holds_over_long_chunks_of_precise_sensors(precise: float) -> None:
    """Rounding grew from row to row of the pass backwards: slopes of 1e50 and more, and levels that never moved.

    Two masses, each pushed by a disturbance that lasts; of the second the speed is measured too.
    """
    rows, dt, observed = 500, 0.01, np.array([0, 1, 3])
    random = np.random.default_rng(1)
    slopes = np.zeros((rows, 1, 4, 6))
    rates = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-3, 0, -2, 1], [0, 0, 2, -1]])
    slopes[:, 0, :, :4] = np.eye(4) + dt * rates
    slopes[:, 0, 2, 4] = slopes[:, 0, 3, 5] = dt
    keep, white, live = np.full(2, 0.95), np.full(2, 1e-4), np.ones((rows, 1), bool)
    gust = 1.0 - keep**2
    missed, seen = np.zeros((rows, 1, 4)), np.zeros((rows, 1, 3))
    x = np.zeros(6)
    for k in range(rows - 1):
        x[:4] = slopes[k, 0] @ x + slopes[k, 0, :, 4:] @ (0.01 * random.standard_normal(2))
        x[4:] = keep * x[4:] + np.sqrt(gust) * random.standard_normal(2)
        seen[k + 1, 0] = x[observed] + (precise, precise, 0.1) * random.standard_normal(3)

    def passed(sensor: np.ndarray, pushed: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Log likelihood, and its slopes in the variances of the sensors and of white disturbances."""
        whitening, gain, spread = (np.zeros((rows, 1, *shape)) for shape in ((3, 3), (6, 3), (6, 2)))
        noise = (keep, pushed, gust, sensor, np.ones((1, 6)), observed, np.zeros((0, 0, 0), bool))
        kernels.covariances(0, 1, slopes, *noise, whitening, gain, spread)
        errors, whitened = np.zeros((rows, 1, 3)), np.zeros((rows, 1, 3))
        left, nats = np.zeros((rows, 1, 6)), np.zeros((rows, 1))
        kernels.means(
            0, 1, slopes, keep, np.zeros((1, 4)), missed, seen, observed, live, whitening, gain,
            errors, whitened, left, nats,
        )  # fmt: skip
        parts = [np.zeros((1, 3)), *(np.zeros((1, 2)) for _ in range(4))]
        kernels.adjoints(0, 1, slopes, keep, observed, whitening, gain, whitened, left, spread, live, *parts)
        return float(nats[1:].sum()), parts[0][0], parts[1][0]

    sensor = np.array([precise**2, precise**2, 0.01])
    _, of_sensors, of_white = passed(sensor, white)
    for j in range(2):
        up, down = (passed(sensor, white * (1.0 + way * 1e-3 * np.eye(2)[j]))[0] for way in (1.0, -1.0))
        assert white[j] * of_white[j] == pytest.approx((up - down) / 2e-3, rel=1e-2, abs=1e-2)
    up, down = (passed(sensor * (1.0 + way * 1e-3 * np.eye(3)[2]), white)[0] for way in (1.0, -1.0))
    assert sensor[2] * of_sensors[2] == pytest.approx((up - down) / 2e-3, rel=1e-2, abs=1e-2)
