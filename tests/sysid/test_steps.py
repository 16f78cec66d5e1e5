"""Runs cut into steps: both ends of every interval, never across a gap."""

import numpy as np
import pytest

from nsde_torch.data import Run
from nsde_torch.errors import DataError
from nsde_torch.inference.steps import steps_of
from nsde_torch.systems import make_system

SPRING = make_system("mass_spring_damper")


def run(n: int = 20, *, gap_after: int | None = 12) -> Run:
    t = 0.01 * np.arange(n)
    segments = ()
    if gap_after:
        t[gap_after:] += 1.0
        segments = ((0, gap_after), (gap_after, n))
    x = np.stack([np.arange(n), 100.0 + np.arange(n)], 1)
    return Run("r", t, x, -np.arange(n)[:, None], segments=segments)


def test_a_step_has_both_ends_and_the_input_held_over_it() -> None:
    steps = steps_of(SPRING, [run(), run(5, gap_after=None)], clock=1.1, smooth=False)
    assert steps.segments == ((0, 11), (11, 18), (18, 22))
    assert steps.runs == (0, 0, 1)
    assert (len(steps), steps.run_in) == (22, None)
    np.testing.assert_array_equal(steps.x1[:, 0] - steps.x0[:, 0], 1.0)
    np.testing.assert_array_equal(steps.u[:, 0], -steps.x0[:, 0])
    assert (steps.logged_dt, steps.dt) == (0.01, pytest.approx(0.011))
    assert steps.starts.tolist() == [0] * 11 + [11] * 7 + [18] * 4


def test_short_segments_are_left_out_and_none_left_is_refused() -> None:
    steps = steps_of(SPRING, [run()], clock=1.0, smooth=False, shortest=8)
    assert steps.segments == ((0, 11),)
    with pytest.raises(DataError, match="no stretch of 50 steps"):
        steps_of(SPRING, [run()], clock=1.0, smooth=False, shortest=50)


def test_the_first_steps_of_a_segment_only_bring_up_memory() -> None:
    lagging = make_system("hexacopter", effects=["motor_lag"])
    x = np.zeros((900, 13))
    x[:, 6] = 1.0
    x[:, 0] = 0.01 * np.arange(900)  # a log in which nothing moves is refused
    flight = Run("f", 0.01 * np.arange(900), x, np.arange(900.0)[:, None] * np.ones(6))
    steps = steps_of(lagging, [flight], clock=1.0, smooth=False)
    assert (len(steps.run_in), len(steps)) == (40, 859)
    assert steps.run_in.u[-1, 0] == 39
    assert steps.u[0, 0] == 40
