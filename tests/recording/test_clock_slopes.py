"""The clock against kinematics, where rows are few for the motion: the quadrature of a rate does not bend it."""

from __future__ import annotations

import numpy as np
import pytest

from nsde_torch.data.kinematics import Slope, clock_slopes
from nsde_torch.systems import make_system

SPRING = make_system("mass_spring_damper")
DT = 0.05


def slope(hertz: float, *, noise: float = 0.0, clock: float = 1.0) -> Slope:
    """Of a wave, 60 s at 20 Hz by the log's clock."""
    rng = np.random.default_rng(1)
    turn, t = 2.0 * np.pi * hertz, clock * DT * np.arange(1200)
    x = np.stack([np.sin(turn * t), turn * np.cos(turn * t)], 1)
    x = x + noise * rng.standard_normal(x.shape) * [1.0, turn]
    (found,) = clock_slopes(SPRING, "a", [x], dt=DT)
    return found


@pytest.mark.parametrize(("hertz", "within"), [(0.5, 1e-3), (1.1, 2e-3), (2.1, 0.015)])
def test_a_right_clock_is_right_however_few_rows_a_wave_has(hertz: float, within: float) -> None:
    found = slope(hertz)
    assert found.value == pytest.approx(1.0, abs=within)


@pytest.mark.parametrize("hertz", [1.1, 2.1, 3.1, 4.1])
def test_what_quadrature_leaves_is_in_the_error(hertz: float) -> None:
    found = slope(hertz, noise=0.02)
    assert abs(found.value - 1.0) < 3.0 * found.error


def test_a_wrong_clock_is_still_measured_in_noise() -> None:
    found = slope(0.9, noise=0.05, clock=1.05)
    assert found.value == pytest.approx(1.05, abs=3.0 * found.error)
    assert found.error < 0.02
