"""Logs of simulations without any noise: what arithmetic leaves of right physics is nothing that is missing."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

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


def solved(damping: float, digits: int) -> list[RawRun]:
    """A spring with quadratic damping, solved to twelve digits and written with fewer."""
    rng = np.random.default_rng(3)
    out = []
    for name in "abcd":
        t, a, w = DT * np.arange(300), rng.uniform(0.5, 2.0, 3), rng.uniform(0.5, 6.0, 3)
        u = sum(a[:, None] * np.sin(w[:, None] * t + rng.uniform(0.0, 6.0, (3, 1))))
        x, y = np.empty((len(t), 2)), np.array([rng.uniform(-0.3, 0.3), 0.0])
        for k, force in enumerate(u):

            def rates(_: float, z: NDArray[np.float64], f: float = force) -> list[float]:
                return [z[1], f - 4.0 * z[0] - 0.5 * z[1] - damping * z[1] * abs(z[1])]

            x[k] = np.round(y, digits)
            y = solve_ivp(rates, (0.0, DT), y, rtol=1e-9, atol=1e-11).y[:, -1]
        out.append(RawRun(name, t, x, u[:, None]))
    return out


@pytest.mark.slow
@pytest.mark.parametrize("digits", [12, 6])
def test_of_a_simulation_without_noise_what_is_missing_is_named_and_nothing_else(digits: int) -> None:
    found = nsde_torch.diagnose(solved(0.0, digits), system="mass_spring_damper", say=False)
    assert (found.verdict, found.added) == ("no_effect", [])
    found = nsde_torch.diagnose(solved(0.05, digits), system="mass_spring_damper", say=False)
    assert (found.verdict, found.added) == ("effect_found", ["quadratic_damping"])


@pytest.mark.slow
def test_a_simulation_without_noise_that_lacks_nothing_is_told_so() -> None:
    found = nsde_torch.diagnose(chirps(0.0), system="mass_spring_damper")
    assert found.outcome.declared.arithmetic
    assert found.verdict == "no_effect"
    assert not found.outcome.structured


@pytest.mark.slow
def test_a_millionth_of_structure_is_arithmetic_and_a_thousandth_is_not() -> None:
    for size, arithmetic in ((1e-6, True), (1e-3, False)):
        runs = nsde_torch.read(chirps(size), system="mass_spring_damper").runs
        fitted = rough_fit(SPRING, runs)
        assert fitted.arithmetic == arithmetic
