"""What is there in one run only is told as that, and never where every run has it or none."""

import numpy as np
import pytest

from nsde_torch.diagnosis.residual_tests import Dependence, dependences, in_one_run
from tests.helpers.residuals import MadeResiduals, Push, made_residuals


def found(push: Push | None, runs: int, seed: int = 0) -> Dependence | None:
    """The test of one run on the speed, of white innovations and a push."""
    left = made_residuals(runs).made(push, seed)
    functions, odd = left.functions["q_dot"]()
    return in_one_run(left, 0, "q_dot", functions, odd)


@pytest.mark.parametrize("runs", [3, 6])
def test_the_run_is_named_that_a_friction_acts_in(runs: int) -> None:
    this = found(lambda q, v, t, run: np.where(run == 1, -0.03 * np.sign(v), 0.0), runs)
    assert this.run == 1
    assert this.p < 1e-3


def test_a_friction_in_all_runs_or_in_two_of_them_is_in_no_run_only() -> None:
    for where in ({0, 1, 2, 3, 4, 5}, {1, 4}):
        own = list(where)
        this = found(lambda q, v, t, run, own=own: np.where(np.isin(run, own), -0.01 * np.sign(v), 0.0), 6)  # type: ignore[misc]
        assert this.p > 1e-4  # of a hundred tests that is nothing


def test_a_line_for_each_run_does_not_hide_a_friction_in_one() -> None:
    left = MadeResiduals((10.0,) * 8).made(lambda q, v, t, run: np.where(run == 2, -0.02 * np.sign(v), 0.0))
    tests = dependences(left)
    best = {d.variable: d for d in tests if d.everywhere}
    (this,) = (d for d in tests if d.variable == "q_dot" and d.run is not None and d.moment is None)
    # eight slopes of the speed, which say nothing of friction
    assert best["q_dot by run"].excess > this.excess
    assert this.run == 2
    assert this.p < 1e-3


def test_of_two_runs_nobody_knows_which_is_the_odd_one() -> None:
    assert found(lambda q, v, t, run: np.where(run == 1, -0.1 * v, 0.0), 2) is None
