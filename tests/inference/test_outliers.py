"""Measurements that nothing explains count as none."""

from dataclasses import replace

import numpy as np
import pytest

from nsde_torch.inference import LogLikelihood
from nsde_torch.inference.estimate import maximised
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import recorded
from tests.inference.springs import B, K, linear_runs, spring, value

ROWS, FIRST, COUNT = 3000, 1777, 10


@pytest.mark.parametrize("by", [0.1, 1.0, 5.0])
def test_a_jump_of_ten_rows_is_left_out_and_moves_nothing(by: float) -> None:
    """As markers jump that a camera system confuses: far off for a moment, and back on the way."""
    runs = linear_runs(8, ROWS * 0.02, seed=2)
    x = np.array(runs[1].x)
    x[FIRST : FIRST + COUNT, 0] += by
    problem = LogLikelihood(spring(), [runs[0], replace(runs[1], x=x), *runs[2:]])
    found, at = maximised(problem)
    sound, _ = maximised(LogLikelihood(spring(), runs))
    row = problem.space.chunks.row[problem.outliers.any(-1)]
    assert sorted(row.tolist()) == [ROWS + FIRST + k for k in range(COUNT)]
    assert at.outlier_times == {1: runs[1].t[FIRST : FIRST + COUNT].tolist()}
    for name in (K, B):
        (here, _), (there, error) = value(found, name), value(sound, name)
        assert here == pytest.approx(there, abs=0.2 * error)
    assert found.likelihood > sound.likelihood - 10 * COUNT


def test_a_sound_log_has_no_outliers() -> None:
    problem = LogLikelihood(spring(), linear_runs(2, 20.0))
    maximised(problem)
    assert not bool(problem.outliers.any())


def test_rows_that_an_effect_explains_are_no_outliers_any_more() -> None:
    """A force that was cut to a limit in a few rows: they are left out before anybody knows of the limit."""
    runs = recorded("mass_spring_damper", durations=(20.0,) * 4).runs
    most = max(float(abs(run.u).max()) for run in runs)
    # what was asked for in the rows of the largest force is more than the limit let through
    more = [np.where(abs(run.u) > 0.995 * most, np.sign(run.u) * 10.0 * most, run.u) for run in runs]
    cut = [replace(run, u=u) for run, u in zip(runs, more, strict=True)]
    problem = LogLikelihood(make_system("mass_spring_damper"), cut, run_in=True)
    _, before = maximised(problem)
    assert before.outlier_times
    level = {"actuator_saturation.level": most}
    limited = make_system("mass_spring_damper", effects=["actuator_saturation"], values=level)
    _, after = maximised(problem.of(limited), before)
    assert bool(after.of.outliers.any())
    assert not after.outlier_times
