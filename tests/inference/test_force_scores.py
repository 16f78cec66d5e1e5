"""Scores of forces against differences of the likelihood itself, and against the columns of its Gram matrices."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nsde_torch.inference import LogLikelihood, MaximumLikelihood, Optimum, nearly_maximised
from nsde_torch.inference.filtering import filtered, with_gains
from nsde_torch.inference.force_scores import ForceScores, directions, force_scores
from nsde_torch.inference.sensitivity import grams
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import recorded
from tests.helpers.residuals import with_own_pass

Fitted = tuple[MaximumLikelihood, Optimum]


@pytest.fixture(scope="module", params=["mass_spring_damper", "cartpole"])
def fitted(request: pytest.FixtureRequest) -> Fitted:
    data = recorded(request.param, durations=(3.0,) * 3)
    return nearly_maximised(LogLikelihood(make_system(request.param), data.runs, run_in=True))


def _scores(fitted: Fitted) -> ForceScores:
    """Scores with no parameters beside them."""
    _, at = fitted
    none = np.zeros(0, dtype=np.int64)
    return force_scores(Optimum(with_own_pass(at.of), at.levels, at.about, at.at, none))


def test_the_score_of_a_force_is_the_slope_of_the_log_likelihood(
    fitted: Fitted,
) -> None:
    best, at = fitted
    found, space = _scores(fitted), at.of.space
    space.use(best.theta)
    acts = space.pushed(at.about.x, at.about.slopes, at.about.after)
    here = filtered(space, at.levels, at.about, at.of.start, space.chunks.counted)
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


def test_the_information_of_draws_is_that_of_columns(fitted: Fitted) -> None:
    best, at = fitted
    found = force_scores(at)
    space = at.of.space
    rng = np.random.default_rng(1)
    functions = np.cumsum(rng.normal(size=(len(space.steps), 3)), 0)
    functions -= functions.mean(0)
    rows = space.chunks.row.numpy()
    space.use(best.theta)
    columns = space.columns(at.about.x, at.about.slopes, best.free.tolist(), at.about.after)
    forces = [(0, torch.from_numpy(functions[rows]))]
    total = grams(space, at.levels, at.about, at.at, columns, forces=forces).total
    k = 1 + len(best.free)
    free = np.linalg.pinv(total[1:k, 1:k], hermitian=True)
    exact = total[k:, k:] - total[k:, 1:k] @ free @ total[1:k, k:]
    pull = total[k:, 0] - total[k:, 1:k] @ free @ total[1:k, 0]
    scores = found.of(functions, 0)
    size = np.sqrt(np.diag(exact))
    np.testing.assert_allclose(scores.total / size, pull / size, atol=0.05)
    scale = size * size[:, None]
    np.testing.assert_allclose(scores.information / scale, exact / scale, atol=0.5)
    # blocks are parts of the whole
    np.testing.assert_allclose(scores.blocks.sum(0), scores.total)
    assert len(found.blocks) == len(scores.blocks)


def test_directions_are_of_unit_information_in_order() -> None:
    rng = np.random.default_rng(2)
    x = rng.normal(size=(50, 4))
    x[:, 2] = x[:, 0] + x[:, 1]
    information = x.T @ x
    turn, kept = directions(information, np.zeros(4))
    assert kept.tolist() == [0, 1, 3]
    np.testing.assert_allclose(turn @ information @ turn.T, np.eye(3), atol=1e-9)
    assert not np.triu(turn, 1)[:, :2].any()


def test_scores_are_of_the_chunks_whose_filter_has_not_diverged(
    fitted: Fitted,
) -> None:
    _, at = fitted
    x = at.x.clone()
    x[:, 0] = torch.nan
    lost = Optimum(with_own_pass(at.of), at.levels, replace(at.about, x=x), at.at, at.free)
    found = force_scores(lost)
    assert np.isfinite(found.forces).all()
    assert np.isfinite(found.drawn).all()
    assert len(found.runs) == at.of.space.chunks.count - 1
    assert force_scores(lost) is found
