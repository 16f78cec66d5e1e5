"""What is left out is predicted as by fits to the rest, and channels together have the density of the row."""

import numpy as np
import pytest

import nsde_torch
from nsde_torch.data import Run
from nsde_torch.inference import LogLikelihood, Optimum, log_likelihood, maximised
from nsde_torch.inference.left_out import Folds, left_out
from nsde_torch.simulation import simulate
from nsde_torch.systems import System, make_system
from tests.inference.springs import linear_runs, spring

EACH = Folds(np.arange(3), np.full(3, -np.inf))


def as_it_stands(system: System, runs: list[Run]) -> Optimum:
    """A pass with the values of the system and the first guess of the noise."""
    problem = LogLikelihood(system, runs)
    levels, about = problem.first(problem.vector.start)
    free = np.arange(len(problem.vector))
    return Optimum(problem, levels, about, problem.filtered(levels, about), free)


def test_a_run_is_predicted_as_by_a_fit_to_the_others() -> None:
    runs = linear_runs(3, 10.0)
    at = maximised(LogLikelihood(spring(), runs))[1]
    found = left_out(at, EACH)
    assert found.names == ("q_dot",)
    for f, run in enumerate(runs):
        best, _ = maximised(LogLikelihood(spring(), [r for r in runs if r is not run]))
        assert (np.abs(found.theta[f] - best.theta) < 0.3 * best.standard_errors).all()
        fitted = spring()
        best.vector.write(fitted, best.theta)
        expected = log_likelihood(fitted, [run], levels=at.levels)
        assert found.density[found.run == f].sum() == pytest.approx(expected, abs=0.5)
        assert (np.diff(found.t[found.run == f]) >= 0).all()
    assert found.density.sum() < at.at.total  # which has seen all
    again = left_out(at, EACH)
    np.testing.assert_array_equal(again.density, found.density)


def test_of_one_run_the_part_before_is_fitted_and_what_comes_after_is_predicted() -> None:
    (run,) = linear_runs(1, 12.0)
    at = maximised(LogLikelihood(spring(), [run]))[1]
    found = left_out(at, Folds(np.zeros(1, dtype=np.int64), np.array([8.0])))
    assert found.theta.shape == (1, 3)
    assert found.t.min() >= 8.0
    assert abs(len(found.t) - 4.0 / run.dt) <= 2
    best, _ = maximised(LogLikelihood(spring(), [run.slice(0, round(8.0 / run.dt))]))
    assert (np.abs(found.theta[0] - best.theta) < 0.5 * best.standard_errors).all()


def test_a_block_of_the_last_row_alone_begins_with_a_step_of_the_log() -> None:
    """A slow log is one chunk of a block a row (120 rows half a second apart ended in an IndexError)."""
    at = as_it_stands(spring(), linear_runs(1, 60.0, dt=0.5))
    assert at.of.space.chunks.places()[1].max() < len(at.of.space.steps)
    assert len(left_out(at, Folds(np.zeros(1, dtype=np.int64), np.array([40.0]))).t)


def test_what_no_other_run_shows_stays_where_all_runs_have_it() -> None:
    runs = linear_runs(3, 6.0)
    quiet = [Run(r.name, r.t, r.x, 0.0 * r.u) for r in runs[1:]]
    pushed = spring()
    at = as_it_stands(pushed, [runs[0], *quiet])
    found = left_out(at, EACH)
    gain = at.of.vector.labels.index("force_gain")
    assert found.theta[0][gain] == pytest.approx(at.of.vector.start[gain], rel=1e-6)
    assert found.theta[1][gain] != pytest.approx(at.of.vector.start[gain], rel=1e-6)


@pytest.mark.slow
def test_a_velocity_that_is_turned_into_the_body_leaves_the_density_of_a_row_as_it_is() -> None:
    made = simulate("hexacopter", seed=1, durations=[4.0], declared_only=True)
    runs = list(nsde_torch.read(made, system="hexacopter").runs)
    at = as_it_stands(make_system("hexacopter"), runs)
    still = np.ones(len(at.of.vector), dtype=np.bool_)
    found = left_out(at, Folds(np.zeros(1, dtype=np.int64), np.full(1, -np.inf)), still)
    assert found.names == ("v_x", "v_y", "v_z", "w_x", "w_y", "w_z")
    np.testing.assert_array_equal(found.theta[0], at.of.space.theta)
    assert found.density.sum() == pytest.approx(at.at.total, rel=1e-9)
