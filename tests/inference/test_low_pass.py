"""States and steps below a frequency: what lies below stays, what lies above goes, and steps go with their states."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nsde_torch.inference import LogLikelihood
from nsde_torch.inference.filtering import linearised_about
from nsde_torch.inference.low_pass import low_passed, rows_apart
from tests.inference.springs import linear_runs, spring

DT, HZ = 0.02, 5.0


def test_what_is_below_stays_and_what_is_above_goes() -> None:
    t = DT * torch.arange(1000, dtype=torch.float64)
    slow = 0.3 + 0.05 * t + torch.sin(2 * torch.pi * 1.7 * t)
    fast = torch.sin(2 * torch.pi * 8.0 * t)
    out = low_passed(torch.stack((slow, slow + fast, fast), 1), HZ, DT, level=True)
    inner = slice(50, -50)
    assert float((out[inner, 0] - slow[inner]).abs().max()) < 0.01
    assert float((out[inner, 1] - slow[inner]).abs().max()) < 0.02
    assert float(out[inner, 2].abs().max()) < 0.02


def test_increments_of_states_without_what_is_above_are_increments_without_it() -> None:
    x = torch.cumsum(torch.from_numpy(np.random.default_rng(0).normal(size=(2000, 1))), 0)
    states = low_passed(x, HZ, DT, level=True)
    steps = low_passed(x[1:] - x[:-1], HZ, DT)
    inner = slice(100, -100)
    error = (states[1:] - states[:-1] - steps)[inner].std()
    assert float(error) < 0.01 * float(steps[inner].std())


@pytest.mark.parametrize(("hz", "rows"), [(50.0, 1), (5.0, 10), (7.0, 7), (1000.0, 1)])
def test_a_band_is_measured_as_often_as_it_says_something_new(hz: float, rows: int) -> None:
    assert rows_apart([], {"q": hz}, DT) == {"q": rows}


def test_a_state_is_measured_as_far_apart_as_its_noise_in_any_run_and_its_band_ask_for() -> None:
    still, undone = (
        replace(run, apart=apart) for run, apart in zip(linear_runs(2, 4.0), ({}, {"q": 4}), strict=True)
    )
    assert rows_apart([undone, still], {"q_dot": 5.0}, DT) == {"q": 4, "q_dot": 10}
    assert rows_apart([still, undone], {"q": 5.0}, DT) == {"q": 10}
    assert LogLikelihood(spring(), [still, undone]).space.every == [4, 1]


def test_a_row_that_measures_nothing_changes_nothing() -> None:
    runs = linear_runs(2, 4.0)
    whole = LogLikelihood(spring(), runs, apart=0.1)
    first, about = whole.first(whole.vector.start)
    at = whole.filtered(first, about)
    assert whole.space.every == [5, 5]
    measured = whole.space.measured
    assert bool((at.rows[~measured.all(-1)] == 0.0).all())
    # other values there do not matter
    moved = [replace(run, x=run.x + 0.5 * (np.arange(len(run.x)) % 5 != 0)[:, None]) for run in runs]
    other = LogLikelihood(spring(), moved, apart=0.1)
    other.space.use(other.vector.start)
    same = linearised_about(other.space, whole.space.chunks.y, other.start)
    assert other.filtered(first, same).total == pytest.approx(at.total, rel=1e-9)
