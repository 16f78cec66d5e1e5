"""Friction that is developed faster than a search looks for has its size, and the width that it has."""

import numpy as np
import pytest

from nsde_torch.data import DataSet
from nsde_torch.data.raw import RawRun
from nsde_torch.recording import assemble
from nsde_torch.sysid import regression as regressions
from nsde_torch.sysid.regression import Regression, narrower, regression_of
from nsde_torch.systems import System, make_system

GAIN, SIZE, WIDTH = 1.0, 0.6, 0.004


def _run(seed: int, width: float) -> RawRun:
    """A mass on a spring at 100 Hz that mostly moves at 2 m/s; Euler and Cromer's rule, a hundred times in a step."""
    rng, dt, inner = np.random.default_rng(seed), 0.01, 100
    t = dt * np.arange(1000)
    force = np.sin(t[:, None] * (0.9, 2.3, 3.1) + rng.uniform(0.0, 6.3, 3)) @ (2.0, 2.0, 1.5)
    x, q, v, h = np.empty((len(t), 2)), 0.0, 0.5, dt / inner
    for i, push in enumerate(force):
        x[i] = q, v
        for _ in range(inner):
            v += h * (GAIN * push - 2.0 * q - 0.3 * v - SIZE * np.tanh(v / width))
            q += h * v
    return RawRun(f"run_{seed}", 100.0 * seed + t, x + 1e-4 * rng.normal(size=x.shape), force[:, None])


@pytest.fixture(scope="module")
def system() -> System:
    return make_system("mass_spring_damper", effects=["coulomb_friction"])


@pytest.fixture(scope="module")
def data(system: System) -> DataSet:
    return assemble([_run(k, WIDTH) for k in range(2)], system, kind="test")


def _value(regression: Regression, name: str) -> float:
    return float(regression.theta[regression.vector.labels.index(name)])


def _off(regression: Regression) -> float:
    """Distance of the size from the truth in standard errors."""
    j = regression.vector.labels.index("coulomb_friction.size")
    basis = regression.shown.basis
    error = np.sqrt((basis @ regression.spread().covariance @ basis.T)[j, j])
    return float(abs(regression.theta[j] - SIZE) / error)


def test_a_width_goes_on_below_the_bound_of_the_search_and_the_size_is_right(
    system: System, data: DataSet
) -> None:
    within = regression_of(system, data.runs)
    within.run(20)
    bound = within.vector.low[within.vector.labels.index("coulomb_friction.width")]
    assert _value(within, "coulomb_friction.width") == pytest.approx(bound, rel=1e-3)
    found = narrower(within, 20)
    assert _value(found, "coulomb_friction.width") < 0.75 * bound
    assert _off(within) > 2.5
    assert _off(found) < 1.5


def test_a_width_that_the_search_finds_stays(system: System) -> None:
    wide = assemble([_run(k, 0.1) for k in range(2)], system, kind="test")
    found = regression_of(system, wide.runs)
    found.run(20)
    assert narrower(found, 20) is found


def test_bounds_are_back_where_going_on_leads_nowhere(
    system: System, data: DataSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = regression_of(system, data.runs)
    found.run(20)
    low = found.vector.low.copy()
    monkeypatch.setattr(regressions, "MOVED", np.inf)
    assert narrower(found, 20) is found
    assert found.vector.low.tolist() == low.tolist()
