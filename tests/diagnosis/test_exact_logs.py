"""Logs of simulations without any noise: what arithmetic leaves of right physics is nothing that is missing."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

import nsde_torch
from nsde_torch.data import RawRun
from nsde_torch.sysid.rough import rough_fit
from nsde_torch.systems import make_system

SPRING = make_system("mass_spring_damper")

DT, GAIN, STIFFNESS, DAMPING = 0.02, 1.0, 3.4, 0.9


def rate(y: NDArray[np.float64], u: float, friction: float) -> NDArray[np.float64]:
    q, v = y
    return np.array([v, GAIN * u - STIFFNESS * q - DAMPING * v - friction * np.tanh(v / 0.02)])


def chirps(friction: float) -> list[RawRun]:
    """A spring under chirps, integrated by Runge-Kutta 4 at 10 ms and written with nine digits."""
    rng = np.random.default_rng(7)
    out = []
    for name in ("a", "b"):
        t = DT * np.arange(600)
        u = 1.5 * np.sin(2.0 * np.pi * (0.1 * t + 0.5 * rng.uniform(2.0, 4.0) / t[-1] * t * t))
        x, y, h = np.empty((len(t), 2)), np.array([rng.uniform(-0.3, 0.3), 0.0]), DT / 2
        for k in range(len(t)):
            x[k] = [float(f"{value:.9g}") for value in y]
            for _ in range(2):
                k1 = rate(y, u[k], friction)
                k2 = rate(y + 0.5 * h * k1, u[k], friction)
                k3 = rate(y + 0.5 * h * k2, u[k], friction)
                y = y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rate(y + h * k3, u[k], friction))
        out.append(RawRun(name, t, x, u[:, None]))
    return out


@pytest.mark.slow
def test_a_simulation_without_noise_that_lacks_nothing_is_told_so() -> None:
    found = nsde_torch.diagnose(chirps(0.0), system="mass_spring_damper")
    assert found.outcome.declared.regression.arithmetic
    assert found.verdict == "no_effect"
    assert not found.outcome.structured


@pytest.mark.slow
def test_a_millionth_of_structure_is_arithmetic_and_a_thousandth_is_not() -> None:
    for size, arithmetic in ((1e-6, True), (1e-3, False)):
        runs = nsde_torch.read(chirps(size), system="mass_spring_damper").runs
        fitted = rough_fit(SPRING, runs)
        assert fitted is not None
        assert fitted.arithmetic == arithmetic
