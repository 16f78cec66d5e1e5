"""A friction that is developed only beyond the speeds of the data is another law: it is sought, or nothing is sure."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import nsde_torch
from nsde_torch.data import RawRun
from nsde_torch.diagnosis.search import bent_shape
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import make_system
from nsde_torch.systems.parameters import ParameterVector
from tests.helpers.diagnosed import assert_interval, diagnosed


@pytest.fixture(scope="module")
def runs() -> list[RawRun]:
    """A spring that is damped where it is stretched: -0.7 q q_dot above zero, by an integrator of its own."""
    rng, out = np.random.default_rng(5), []
    t = np.arange(0.0, 20.0, 0.01)
    for number in range(4):
        waves = np.sin(np.outer(t, rng.uniform(0.2, 2.5, 6)) + rng.uniform(0, 6.28, 6))
        force, gusts = waves @ rng.uniform(0.2, 0.6, 6), 0.3 * rng.standard_normal(len(t))
        x = [np.array([0.3 * rng.standard_normal(), 0.0])]
        for u, w in zip(force[:-1], gusts[:-1], strict=True):

            def rate(_: float, y: np.ndarray, push: float = 1.1 * u + w) -> list[float]:
                return [y[1], push - 1.3 * y[0] - (0.6 + 0.7 * max(y[0], 0.0)) * y[1]]

            x.append(solve_ivp(rate, (0.0, 0.01), x[-1], rtol=1e-6, atol=1e-9).y[:, -1])
        seen = np.array(x) + rng.standard_normal((len(t), 2)) * [0.001, 0.01]
        out.append(RawRun(f"run_{number}", t, seen, force[:, None]))
    return out


@pytest.mark.slow
def test_a_law_is_sought_in_the_place_of_a_friction_that_is_none(runs: list[RawRun]) -> None:
    found = nsde_torch.diagnose(runs, system="mass_spring_damper").content()
    assert found["added"] == ["force = c1 max(q, 0) q_dot"]
    assert_interval(found["parameters"], "force = c1 max(q, 0) q_dot.c1", -0.7)


@pytest.mark.slow
def test_a_friction_that_is_dry_has_no_such_shape() -> None:
    found, content = diagnosed("mass_spring_damper", {"coulomb_friction": {"size": 0.5, "width": 0.01}})
    assert content["added"] == ["coulomb_friction"]
    assert bent_shape(found.outcome.final, "coulomb_friction") == ""


@pytest.mark.slow
def test_where_no_law_may_be_tried_it_is_provisional(runs: list[RawRun]) -> None:
    only = ("position_dependent_friction",)
    found = nsde_torch.diagnose(runs, system="mass_spring_damper", candidates=only).content()
    (finding,) = [f for f in found["findings"] if f["kind"] == "effect"]
    assert finding["name"] == "position_dependent_friction"
    assert finding["lead"]
    assert "another law" in finding["lead_reason"]


def test_a_force_that_repeats_less_than_once_a_turn_is_none_that_repeats() -> None:
    system = make_system("cartpole", effects=["ripple[pole]"])
    vector = ParameterVector(system)
    at = vector.labels.index("ripple[pole].order")
    ends, theta = [], vector.start.copy()
    for order in (float(vector.low[at]), 3.0):
        theta[at] = order
        ends.append(bent_shape(cast(Regression, SimpleNamespace(vector=vector, theta=theta)), "ripple[pole]"))
    assert ends == ["ripple[pole].order", ""]
