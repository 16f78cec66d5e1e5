"""Logs side by side, each with parameters and a prior of its own, are what they are one at a time."""

import numpy as np
import pytest

from nsde_torch.data import Run
from nsde_torch.inference import log_likelihood
from nsde_torch.inference.posterior import LogWithPrior, Posteriors
from tests.inference.springs import TRUTH, levels_of, linear_runs, spring


@pytest.mark.parametrize("effects", [(), ("actuator_lag",)])
def test_logs_side_by_side_have_the_likelihood_that_they_have_alone(effects: tuple[str, ...]) -> None:
    system = spring(*effects)
    own = Posteriors(system, levels_of())
    start = own.vector.start
    runs = linear_runs(3, 5.0, seed=1)
    short = runs[1]
    runs[1] = Run("short", short.t[:60], short.x[:60], short.u[:60])
    none = np.zeros((len(start), len(start)))
    problems = [LogWithPrior((run,), f * start, none) for f, run in zip((1.0, 1.05, 0.9), runs, strict=True)]
    for problem, here in zip(problems, own.at_centres(problems), strict=True):
        (alone,) = own.at_centres([problem])
        assert here.nats == pytest.approx(alone.nats, abs=1e-6)
        np.testing.assert_allclose(here.information, alone.information, rtol=1e-6, atol=1e-3)
        if not effects:  # those that remember bring up their memory first there
            machine = spring()
            own.vector.write(machine, problem.centre)
            whole = log_likelihood(machine, problem.runs, levels=levels_of())
            assert here.nats == pytest.approx(whole, abs=1e-3)


def test_parameters_are_found_within_their_standard_errors_and_the_prior_counts() -> None:
    own = Posteriors(spring(), levels_of())
    truth, runs = own.vector.start, linear_runs(2, 20.0, seed=2)
    assert dict(zip(own.vector.labels, truth, strict=True)) == pytest.approx(dict(TRUTH))
    wide, narrow = (np.diag(1.0 / np.square(share * truth)) for share in (10.0, 1e-4))
    found, held = own.modes([LogWithPrior((runs[0],), 1.5 * truth, k) for k in (wide, narrow)])
    errors = np.sqrt(np.diag(np.linalg.inv(found.information)))
    assert (np.abs(found.theta - truth) < 3.5 * errors).all()
    assert 0.9 < found.excess < 1.1
    assert found.moved < 0.2
    np.testing.assert_allclose(held.theta, 1.5 * truth, rtol=0.01)
    assert held.nats < found.nats
    # of all runs together more is known than of one
    (both,) = own.modes([LogWithPrior(tuple(runs), truth, wide)])
    assert (np.sqrt(np.diag(np.linalg.inv(both.information))) < errors).all()


def test_parameters_stay_within_their_bounds() -> None:
    own = Posteriors(spring(), levels_of())
    own.vector.high = np.minimum(own.vector.high, 0.8 * own.vector.start)
    wide = np.diag(1.0 / np.square(10.0 * own.vector.start))
    (found,) = own.modes([LogWithPrior(tuple(linear_runs(1, 10.0, seed=3)), 0.5 * own.vector.start, wide)])
    assert (found.theta <= own.vector.high).all()
    assert found.theta == pytest.approx(own.vector.high, rel=1e-3)
