"""The score from Gram matrices is that of the likelihood, and at the truth it is what standard errors take it for."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from nsde_torch.data import Run
from nsde_torch.inference import log_likelihood
from nsde_torch.inference.estimate import LogLikelihood
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.sensitivity import Grams, grams
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


@pytest.mark.parametrize(("shared", "expected"), [(0.0, 1.0), (2.0, 41.0)])
def test_scores_that_scatter_more_than_white_innovations_do_are_counted(
    shared: float, expected: float
) -> None:
    rng = np.random.default_rng(4)
    columns = np.ones((400, 10, 1)) * [1.0, 3.0]
    # an error that ten rows of a block share has 1 + 10 s^2 times the variance of their sum
    errors = rng.normal(size=(400, 10, 1)) + shared * rng.normal(size=(400, 1, 1))
    columns[..., 1] *= rng.choice([-1.0, 1.0], size=(400, 1))
    rows = np.concatenate((errors, columns), -1)
    found = Grams(rows.transpose(0, 2, 1) @ rows, 4000, 2)
    assert found.inflation(np.array([0, 1])) == pytest.approx(expected, rel=0.15)
    assert found.inflation(np.array([], dtype=np.int64)) == 1.0
