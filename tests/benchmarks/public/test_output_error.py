"""Output-error estimates find the parameters of rollouts, with initial states that nobody measured."""

import numpy as np
import pytest

from nsde_benchmarks.public.output_error import output_error, simulated, windows
from nsde_torch.errors import DataError
from nsde_torch.systems import System, make_system

TRUTH = {"force_gain": 1.3, "linear_spring.stiffness": 9.0, "viscous_friction.damping": 0.4}


def _spring(values: dict[str, float], *effects: str) -> System:
    return make_system("mass_spring_damper", effects=effects, values=values).double()


def _measured(noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    u = np.repeat(rng.standard_normal(10), 20)[None, :, None]
    truth = _spring({**TRUTH, "cubic_stiffness.stiffness": 5.0}, "cubic_stiffness")
    x = simulated(truth, np.array([[0.3, 0.0]]), u, dt=0.02)[0]
    return x + noise * rng.standard_normal(x.shape), u[0]


@pytest.mark.slow
def test_parameters_are_found_from_positions_alone() -> None:
    x, u = _measured()
    x[:, 1] = 0.0  # nobody measured it
    system = _spring({}, "cubic_stiffness")
    data = windows([x], [u], dt=0.02, length=50)
    made = output_error(system, data, weights=np.array([100.0, 0.0]), free=(0, 1), iterations=40)
    for name, value in {**TRUTH, "cubic_stiffness.stiffness": 5.0}.items():
        assert made.values[name] == pytest.approx(value, rel=1e-3), name
    assert made.cost[-1] < 1e-8 * made.cost[0]
    assert np.abs(made.starts[:, 1]).max() > 0.1  # velocities that no column held
    assert system.value("force_gain").item() == pytest.approx(1.3, rel=1e-3)


def test_the_cost_never_rises_and_what_is_fixed_stays() -> None:
    x, u = _measured(1e-3)
    system = _spring({"force_gain": 1.1})
    data = windows([x], [u], dt=0.02, length=60, stride=40)
    how = {"fixed": ("force_gain",), "groups": ((0,), (1,)), "iterations": 6}
    made = output_error(system, data, weights=np.array([100.0, 10.0]), **how)
    assert made.values["force_gain"] == pytest.approx(1.1)
    assert made.cost[-1] < made.cost[0]


def test_windows_longer_than_every_run_are_refused() -> None:
    x, u = _measured()
    with pytest.raises(DataError, match=r"the longest has 201"):
        windows([x], [u], dt=0.02, length=300)
