"""Specification tests: their size where nothing is missing, and their power at alternatives of known size.

The innovations of a spring are drawn anew, with what a push does to them.
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from nsde_torch.diagnosis.periodicity import lines
from nsde_torch.diagnosis.residual_tests import Dependence, beyond_chance, dependences
from nsde_torch.inference import LogLikelihood, Optimum, maximised
from nsde_torch.inference.force_scores import force_scores
from nsde_torch.sysid.regression import Regression
from tests.helpers.residuals import MadeResiduals, Push, with_own_pass
from tests.inference.springs import rubbing, small_runs
from tests.inference.springs import spring as declared

Array = NDArray[np.float64]

NULLS, SHAPED = 8, 5


@pytest.fixture(scope="module")
def spring() -> MadeResiduals:
    return MadeResiduals()


@pytest.fixture(scope="module")
def nulls(spring: MadeResiduals) -> list[list[Dependence]]:
    return [dependences(spring.made(seed=seed)) for seed in range(NULLS)]


# ---- size -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_noise_has_no_structure_beyond_chance(nulls: list[list[Dependence]]) -> None:
    # eight data sets at a chance of one in ten: four or more of them would be one case in two hundred
    assert sum(bool(beyond_chance(tests, {}, alpha=0.1)) for tests in nulls) <= 3
    assert not any(beyond_chance(tests, {}, alpha=1e-3) for tests in nulls)


def test_p_values_of_all_tests_of_noise_are_none_too_small(nulls: list[list[Dependence]]) -> None:
    p = np.array([d.p for tests in nulls for d in tests])
    assert len(p) > 150
    for level in (0.01, 0.05, 0.1, 0.2, 0.5):
        assert (p < level).mean() <= level + 3 * (level * (1 - level) / len(p)) ** 0.5


def test_what_the_parameters_can_do_is_no_score(spring: MadeResiduals) -> None:
    left = spring.made(seed=3)
    own = left.forces.of(np.stack((left.columns["q"], left.columns["q_dot"], left.columns["force"]), 1), 0)
    assert own.independent()[1].size == 0


def _drawn(spring: MadeResiduals, seed: int, force: Array | float = 0.0) -> Regression:
    """A regression whose residual is noise and a force."""
    r = spring.regression.under(0, spring.regression.noises[0])
    rng, rows = np.random.default_rng(seed), len(r.series)
    sensor = np.diff(rng.normal(size=rows + 1))
    r.residual = r.residual.copy()
    r.residual[:, r.rows[0]] = 0.006 * rng.normal(size=rows) + 0.006 * sensor + force * r.dt
    return r


def test_the_highest_line_of_noise_is_no_line(spring: MadeResiduals) -> None:
    p = [lines(_drawn(spring, seed))[0].p for seed in range(20)]
    assert np.mean(np.array(p) < 0.1) <= 0.3
    assert min(p) > 1e-4


# ---- power ------------------------------------------------------------------------------------------------


def _friction(size: float) -> Push:
    return lambda q, q_dot, t, run: -size * np.sign(q_dot)


def test_a_friction_is_found_on_its_variable_as_what_it_is(spring: MadeResiduals) -> None:
    for seed in range(SHAPED):
        first = beyond_chance(dependences(spring.made(_friction(0.01), seed)), {}, alpha=0.01)[0]
        assert (first.channel, first.variable, first.run) == ("q_dot", "q_dot", None)
        assert first.odd > 0.8


@pytest.mark.parametrize("run", [1, 3])
def test_a_single_push_is_found_at_its_moment(spring: MadeResiduals, run: int) -> None:
    made = spring.made(lambda q, v, t, of: np.where(of == run, 0.3 * np.exp(-np.square((t - 4) / 0.1)), 0.0))
    moment = next(d for d in dependences(made) if d.moment is not None)
    assert moment.p < 1e-3
    assert (moment.run, moment.moment) == (run, pytest.approx(4.0, abs=0.4))


def test_a_sinusoid_is_found_at_its_frequency(spring: MadeResiduals) -> None:
    rows = np.arange(len(spring.regression.series)) * spring.regression.dt
    for frequency in (3.7, 9.1):
        (first, *_) = lines(_drawn(spring, 0, 0.4 * np.sin(2 * np.pi * frequency * rows)))
        assert first.p < 1e-4
        assert first.frequency == pytest.approx(frequency, abs=0.1)


# ---- the adjoint ------------------------------------------------------------------------------------------


def test_scores_are_slopes_of_the_likelihood_of_the_machine() -> None:
    """A force that goes with the speed is a damping: one score is the other's."""
    best, at = maximised(LogLikelihood(declared(), small_runs(rubbing(0.0), 2, 6.0, seed=1)), nuisances=False)
    damping = next(j for j, label in enumerate(best.vector.labels) if label.endswith("damping"))
    others = best.free[best.free != damping]
    found = force_scores(Optimum(with_own_pass(at.of), at.levels, at.about, at.at, others))
    space, about = at.of.space, at.about
    middle = space.midway(about.x, about.after)
    speed = np.empty(len(space.steps))
    speed[space.chunks.row.flatten().numpy()] = middle.flatten(0, 1)[:, 1].numpy()
    alone = found.of(-speed[:, None], 0)
    # standard error of the damping with all others free, by the draws and by the Gram matrices
    expected = best.spread.covariance[list(best.free).index(damping), list(best.free).index(damping)]
    assert 1.0 / float(alone.information[0, 0]) == pytest.approx(expected, rel=0.5)
    assert abs(float(alone.total[0])) < 0.3 * float(alone.information[0, 0]) ** 0.5
