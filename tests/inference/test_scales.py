"""The same machine in other units of length and time, and small parameters: what is typical is what data are like."""

from collections.abc import Mapping
from typing import final

import numpy as np
import pytest
from torch import Tensor

import nsde_torch
from nsde_torch.arrays import Array
from nsde_torch.data import Run
from nsde_torch.data.raw import RawRun
from nsde_torch.effects import Parameter, Port
from nsde_torch.inference import fit
from nsde_torch.systems import Defaults, ErrorGroup, ResidualPort, System
from tests.helpers.machines import held, simulated
from tests.inference.springs import B, G, K, assert_near, spring

CUBIC = "cubic_stiffness.stiffness"
TRUTH = {G: 1.3, K: 4.0, B: 0.3, CUBIC: 2.0}
DT, FINE = 0.02, 20


def hardening_runs(metres: float, *, steps: int = 100, dt: float = DT, fine: int = FINE) -> list[Run]:
    """Springs that harden, by small steps of their own; a length and a force of 1 are so many in the log."""
    rng, out, h = np.random.default_rng(4), [], dt / fine
    for number in range(2):
        u = np.repeat(rng.uniform(-2.0, 2.0, steps), round(0.2 / dt))
        x, rows = np.array([0.5, 0.0]), np.empty((len(u), 2))
        for k, force in enumerate(u):
            rows[k] = x
            for _ in range(fine):
                v = x[1] + 0.5 * h * _force(x, force)
                x = x + h * np.array([v, _force(np.array([x[0] + 0.5 * h * x[1], v]), force)])
        seen = metres * (rows + rng.standard_normal(rows.shape) * (0.002, 0.005))
        out.append(Run(f"r{number}", dt * np.arange(len(u), dtype=np.float64), seen, metres * u[:, None]))
    return out


def _force(x: np.ndarray, u: float) -> float:
    return float(TRUTH[G] * u - TRUTH[K] * x[0] - TRUTH[B] * x[1] - TRUTH[CUBIC] * x[0] ** 3)


@pytest.mark.parametrize("metres", [1e-9, 1e-6, 1e-3, 1.0, 1e6])
def test_a_spring_that_hardens_is_fitted_in_any_unit(metres: float) -> None:
    truth = {**TRUTH, CUBIC: TRUTH[CUBIC] / metres**2}
    first = {**truth, CUBIC: 0.6 * truth[CUBIC]}
    found = fit(spring("cubic_stiffness", values=first), hardening_runs(metres))
    assert found.settled
    assert_near(found, truth)


@pytest.mark.slow
def test_a_machine_that_oscillates_fast_keeps_the_rows_that_show_it() -> None:
    slow, faster = hardening_runs(1.0, steps=2000, dt=0.1, fine=40), 500.0  # rows of 0.2 ms
    runs = [RawRun(one.name, one.t / faster, one.x * (1.0, faster), one.u * faster**2) for one in slow]
    few = ("cubic_stiffness", "coulomb_friction", "actuator_lag")
    values = {K: TRUTH[K] * faster**2, B: TRUTH[B] * faster}
    found = nsde_torch.diagnose(
        runs, system="mass_spring_damper", parameters=values, candidates=few, say=False
    )
    assert found.added == ["cubic_stiffness"]
    # in rows of 2.6 ms, twelve a period, it was 6 % too large
    assert found.parameters[CUBIC]["value"] == pytest.approx(TRUTH[CUBIC] * faster**2, rel=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("second", [1e-4, 300.0])
def test_a_machine_is_diagnosed_at_any_pace(second: float) -> None:
    rng, runs = np.random.default_rng(1), []
    for number in range(3):

        def rates(x: Array, u: Array) -> Array:
            q, v, pushed = x
            return np.array([v, pushed - 4.0 * q - 0.5 * v - 0.3 * np.tanh(v / 0.01), (u[0] - pushed) / 0.15])

        noise = (0.002, 0.005, 0.0)
        inputs = held(rng, -3.0, 3.0, 1500, each=40)
        one = simulated(number, rates, (0.3, 0.0, 0.0), inputs, 0.02, rng=rng, noise=noise)
        x = one.x[:, :2] * (1.0, 1.0 / second)
        runs.append(RawRun(one.name, one.t * second, x, one.u / second**2))
    values = {G: 1.0, K: 4.0 / second**2, B: 0.5 / second}
    few = (
        "coulomb_friction",
        "actuator_lag",
        "input_delay",
        "cubic_stiffness",
        "hidden_mass",
        "quadratic_damping",
    )
    found = nsde_torch.diagnose(
        runs, system="mass_spring_damper", parameters=values, candidates=few, say=False
    )
    assert {*found.added} == {"coulomb_friction", "actuator_lag"}
    low, high = found.parameters["actuator_lag.time_constant"]["interval_90"]
    assert low < 0.15 * second < high


TORQUE, INERTIA, BRAKE = 1e-3, 2e-6, 1e-6


@final
class Rotor(System):
    """w' = (torque u - brake w) / inertia."""

    name = "rotor"
    state_names, state_units = ("w",), ("rad/s",)
    input_names, input_units = ("u",), ("1",)
    ports = {Port.FORCE: 1}
    residual_ports = {Port.FORCE: ResidualPort(1, 1.0, "rad/s2")}
    defaults = Defaults(0.01, 20, (0.1,), 0.1, 1.0, "euler_maruyama")
    PARAMETERS = {
        "inertia": Parameter(INERTIA, "kg m2", low=0.0),
        "brake": Parameter(BRAKE, "N m s", low=0.0),
    }
    error_names = state_names
    error_groups = (ErrorGroup("speed", (0,), "rad/s"),)
    feature_names, feature_units = state_names, state_units

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        rate = (TORQUE * u - self.value("brake") * x) / self.value("inertia")
        return rate + forces[Port.FORCE] if Port.FORCE in forces else rate

    def features(self, x: Tensor) -> Tensor:
        return x


def test_an_inertia_of_a_small_motor_is_fitted() -> None:
    rng, keep = np.random.default_rng(5), np.exp(-BRAKE / INERTIA * 0.01)
    u = np.repeat(rng.uniform(-1.0, 1.0, 60), 20)
    w = np.zeros(len(u))
    for k in range(len(u) - 1):
        w[k + 1] = keep * w[k] + (1.0 - keep) * TORQUE / BRAKE * u[k]
    system = Rotor()
    system.set_value("inertia", [2.0 * INERTIA])
    system.set_value("brake", [3.0 * BRAKE])
    seen = w + 0.05 * rng.standard_normal(len(w))
    found = fit(system, [Run("r", 0.01 * np.arange(len(u), dtype=np.float64), seen[:, None], u[:, None])])
    assert found.settled
    assert_near(found, {"inertia": INERTIA, "brake": BRAKE}, share=0.05)


@pytest.mark.parametrize("metres", [1e-6, 1e3])
def test_a_spring_that_hardens_is_named_in_any_unit(metres: float) -> None:
    runs = [RawRun(one.name, one.t, one.x, one.u) for one in hardening_runs(metres)]
    few = ("cubic_stiffness", "coulomb_friction", "stop_above", "actuator_saturation", "actuator_lag")
    found = nsde_torch.diagnose(runs, system="mass_spring_damper", candidates=few, say=False)
    assert found.added == ["cubic_stiffness"]
    low, high = found.parameters[CUBIC]["interval_90"]
    assert low < TRUTH[CUBIC] / metres**2 < high
