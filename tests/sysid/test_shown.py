"""What a regression shows, and what it does not, in words; one step of it within bounds."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from nsde_torch.sysid.regression import bounded_step, sentences, shown

LABELS, UNITS = ["a", "b", "c"], ["1/s", "m", "1"]
SCALE = np.array([1.0, 2.0, 0.5])


def columns(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(400, 3))


def test_of_independent_columns_everything_is_shown() -> None:
    found = shown(columns(), SCALE)
    assert (found.rank, found.lost.shape) == (3, (3, 0))
    assert found.known.all()
    assert 1.0 <= found.condition < 1.5
    assert sentences(found, LABELS, UNITS, SCALE) == []


def test_a_column_of_zeros_is_named_alone() -> None:
    slopes = columns()
    slopes[:, 1] = 0.0
    found = shown(slopes, SCALE)
    assert found.known.tolist() == [True, False, True]
    assert sentences(found, LABELS, UNITS, SCALE) == ["b: nothing in the data depends on it"]


def test_proportional_columns_are_named_together_with_the_change_that_nothing_shows() -> None:
    slopes = columns()
    slopes[:, 2] = -4.0 * slopes[:, 0]
    found = shown(slopes, SCALE)
    assert found.known.tolist() == [False, True, False]
    np.testing.assert_allclose(slopes @ found.lost, 0.0, atol=1e-9)
    (said,) = sentences(found, LABELS, UNITS, SCALE)
    assert said.startswith("a and c: only together; the data look the same with a by ")
    assert "1/s, c by " in said


def test_nothing_at_all_is_shown_by_zeros() -> None:
    found = shown(np.zeros((50, 3)), SCALE)
    assert found.rank == 0
    assert not found.known.any()
    assert len(sentences(found, LABELS, UNITS, SCALE)) == 3


# ---- steps ------------------------------------------------------------------------------------------------

SIZES = np.array([1.0, 10.0, 0.1])


def problem(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    slopes = rng.normal(size=(200, 3)) * [3.0, 0.2, 40.0]
    return slopes, slopes @ [1.0, 5.0, -0.2] + rng.normal(size=200)


def test_without_active_bounds_it_is_ordinary_least_squares() -> None:
    slopes, residual = problem(0)
    wide = np.full(3, 1e3)
    step = bounded_step(slopes, residual, shown(slopes, SIZES), -wide, wide, SIZES)
    np.testing.assert_allclose(step, np.linalg.lstsq(slopes, residual, rcond=None)[0], rtol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_with_active_bounds_it_is_the_minimum_within_them_and_not_the_clipped_one(seed: int) -> None:
    slopes, residual = problem(seed)
    slopes[:, 1] += slopes[:, 0]  # so that clipping alone would be wrong
    low, high = np.array([-0.5, -3.0, -0.05]), np.array([0.5, 3.0, 0.05])
    step = bounded_step(slopes, residual, shown(slopes, SIZES), low, high, SIZES)
    assert ((step >= low) & (step <= high)).all()
    best = lsq_linear(slopes, residual, bounds=(low, high), tol=1e-12).x
    np.testing.assert_allclose(step, best, rtol=1e-5, atol=1e-7)


def test_along_a_direction_that_is_not_shown_the_step_is_finite_and_within_the_bounds() -> None:
    slopes, residual = problem(1)
    slopes[:, 2] = 30.0 * slopes[:, 0]  # only x_0 + 30 x_2 is shown
    found = shown(slopes, SIZES)
    assert found.rank == 2
    wide = 1e3 * SIZES
    free = bounded_step(slopes, residual, found, -wide, wide, SIZES)
    best = np.linalg.lstsq(slopes, residual, rcond=None)[0]  # that of least norm
    np.testing.assert_allclose(slopes @ free, slopes @ best, atol=1e-8)
    assert np.linalg.norm(free / SIZES) < 3 * np.linalg.norm(best / SIZES)
    room = 0.1 * SIZES
    step = bounded_step(slopes, residual, found, -room, room, SIZES)
    assert (np.abs(step) <= room).all()
    assert abs((found.lost[:, 0] / SIZES**2) @ step) < 0.1
