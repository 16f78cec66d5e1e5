"""One step of least squares within bounds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from nsde_torch.sysid.regression import bounded_step, shown

SCALE = np.array([1.0, 10.0, 0.1])


def problem(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    slopes = rng.normal(size=(200, 3)) * [3.0, 0.2, 40.0]
    return slopes, slopes @ [1.0, 5.0, -0.2] + rng.normal(size=200)


def test_without_active_bounds_it_is_ordinary_least_squares() -> None:
    slopes, residual = problem(0)
    wide = np.full(3, 1e3)
    step = bounded_step(slopes, residual, shown(slopes, SCALE), -wide, wide, SCALE)
    np.testing.assert_allclose(step, np.linalg.lstsq(slopes, residual, rcond=None)[0], rtol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_with_active_bounds_it_is_the_minimum_within_them_and_not_the_clipped_one(seed: int) -> None:
    slopes, residual = problem(seed)
    slopes[:, 1] += slopes[:, 0]  # so that clipping alone would be wrong
    low, high = np.array([-0.5, -3.0, -0.05]), np.array([0.5, 3.0, 0.05])
    step = bounded_step(slopes, residual, shown(slopes, SCALE), low, high, SCALE)
    assert ((step >= low) & (step <= high)).all()
    best = lsq_linear(slopes, residual, bounds=(low, high), tol=1e-12).x
    np.testing.assert_allclose(step, best, rtol=1e-5, atol=1e-7)


def test_along_a_direction_that_is_not_shown_the_step_is_finite_and_within_the_bounds() -> None:
    slopes, residual = problem(1)
    slopes[:, 2] = 30.0 * slopes[:, 0]  # only x_0 + 30 x_2 is shown
    found = shown(slopes, SCALE)
    assert found.rank == 2
    wide = 1e3 * SCALE
    free = bounded_step(slopes, residual, found, -wide, wide, SCALE)
    best = np.linalg.lstsq(slopes, residual, rcond=None)[0]  # that of least norm
    np.testing.assert_allclose(slopes @ free, slopes @ best, atol=1e-8)
    assert np.linalg.norm(free / SCALE) < 3 * np.linalg.norm(best / SCALE)
    room = 0.1 * SCALE
    step = bounded_step(slopes, residual, found, -room, room, SCALE)
    assert (np.abs(step) <= room).all()
    assert abs((found.lost[:, 0] / SCALE**2) @ step) < 0.1
