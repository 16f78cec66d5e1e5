"""Logs of simulations without any noise: what arithmetic leaves of right physics is nothing that is missing."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

import nsde_torch
from nsde_torch.data import RawRun

DT = 0.02


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
