"""Calibration: the factor on sigma that makes intervals right is found, and carried to a new run by the formula."""

import math

import pytest

from nsde_torch.data import Run
from nsde_torch.evaluation.figures import Coverage, extrapolate, falls_short
from tests.helpers.toy_systems import Decay, decay_runs, fix_sigma, make_model

SIGMA = 0.5


@pytest.fixture(scope="module")
def runs() -> list[Run]:
    """300 s of a decay with noise."""
    return decay_runs(3, 100.0, sigma=SIGMA)


@pytest.mark.parametrize(
    ("wrong", "factor", "within"),
    [
        *((wrong, 1.0 / wrong, 0.2) for wrong in (0.5, 1.0, 2.0)),
        (2e-3, 6.0, 0.02),  # as far as the bracket goes
        (2e3, 1.0, 1e-12),  # intervals that hold too much by every factor are not narrowed
    ],
)
@pytest.mark.slow
def test_the_factor_undoes_a_sigma_that_is_deliberately_wrong(
    runs: list[Run], wrong: float, factor: float, within: float
) -> None:
    model = fix_sigma(make_model(Decay), wrong * SIGMA)
    found = Coverage(model, runs, seed=0, compile=False).log_factor()
    assert found == pytest.approx(math.log(factor), abs=within)


def test_the_factor_stays_at_one_where_the_intervals_hold_already() -> None:
    class Fixed(Coverage):
        def __init__(self, held: float) -> None:
            self.held = held

        def __call__(self, log_factor: float) -> float:
            return self.held

    assert Fixed(0.91).log_factor() == 0.0
    assert Fixed(0.89).log_factor() == pytest.approx(math.log(6.0))
    assert falls_short(Fixed(0.89).log_factor())
    assert not falls_short(Fixed(0.91).log_factor())


def test_coverage_rises_with_the_factor_is_nine_tenths_at_the_truth_and_one_where_paths_diverge(
    runs: list[Run],
) -> None:
    coverage = Coverage(fix_sigma(make_model(Decay), SIGMA), runs, seed=0, compile=False)
    values = [coverage(f) for f in (-1.0, -0.3, 0.0, 0.3, 1.0)]
    assert values == sorted(values)
    assert values[2] == pytest.approx(0.9, abs=0.04)
    assert coverage(300.0) == 1.0


def test_extrapolation_takes_the_share_of_the_excess_that_a_new_run_still_sees() -> None:
    assert extrapolate(0.2, [], 1) == 0.2
    for n in (2, 3, 10):
        assert extrapolate(0.1, [0.4, 0.6, 0.5], n) == pytest.approx(0.1 + 0.4 * (n - 1) / n)

    assert extrapolate(0.3, [0.0, 0.1], 2) == 0.3  # a run left out never narrows
