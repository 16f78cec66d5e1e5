"""Steps that are exact for what is linear, however fast it settles; the likelihood of a motor with such a current."""

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from torch import Tensor

import nsde_torch
from nsde_torch.diagnosis.joint_selection import fitted_at
from nsde_torch.effects import Port
from nsde_torch.inference import LogLikelihood
from nsde_torch.sde.exponential import exponentials, stiff_change
from nsde_torch.sysid.regression import regression_of
from tests.helpers.electric_motors import BACK, DRAG, PULL, CoilMotor, turns
from tests.helpers.heated_plates import Plate, heated
from tests.inference.springs import rubbing, small_runs, spring


@pytest.mark.parametrize("size", [0.1, 1.0, 30.0])
def test_functions_of_matrices_are_those_of_the_exponential_of_a_wider_one(size: float) -> None:
    a = size * (np.random.default_rng(1).normal(size=(4, 3, 3)) - 2.0 * np.eye(3))
    one, two, three = exponentials(torch.from_numpy(a))
    for found, other in zip((one, two, three), exponentials(torch.from_numpy(a), 8), strict=True):
        np.testing.assert_allclose(found, other, rtol=1e-9, atol=1e-12)  # what is traced is no other function
    for k in range(len(a)):
        wide = np.zeros((12, 12))
        wide[:3, :3] = a[k]
        wide[:3, 3:6] = wide[3:6, 6:9] = wide[6:9, 9:] = np.eye(3)
        whole = expm(wide)
        np.testing.assert_allclose(one[k], whole[:3, 3:6], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(three[k], whole[:3, 9:], rtol=1e-9, atol=1e-12)


def test_a_step_is_exact_for_what_is_linear_and_of_third_order_otherwise() -> None:
    rate = torch.tensor([[0.0, 1.0], [-3.0, -900.0]], dtype=torch.float64)
    x = torch.tensor([[0.4, -0.2]], dtype=torch.float64)
    change = stiff_change(lambda z: z @ rate.T, x, 0.05)
    np.testing.assert_allclose((x + change)[0], expm(0.05 * rate.numpy()) @ x[0].numpy(), rtol=1e-6)

    def nonlinear(z: Tensor) -> Tensor:
        return torch.stack((z[:, 1], -z[:, 0].sin() - 50.0 * z[:, 1] * (1.0 + z[:, 0] ** 2)), 1)

    def after(parts: int) -> Tensor:
        z = x
        for _ in range(parts):
            z = z + stiff_change(nonlinear, z, 0.4 / parts)
        return z

    exact = after(640)
    errors = [float((after(parts) - exact).norm()) for parts in (20, 40, 80)]
    assert np.log2(errors[0] / errors[1]) > 2.5
    assert np.log2(errors[1] / errors[2]) > 2.5


@pytest.mark.parametrize("decay", [60.0, 1000.0])
def test_a_motor_whose_current_settles_within_a_row_is_fitted_as_it_is(decay: float) -> None:
    first = {"fast": 0.9 * decay, "decay": 0.9 * decay, "back": 0.9 * decay * BACK}
    runs, machine = turns(3, decay).runs, CoilMotor(values=first)
    best = fitted_at(LogLikelihood(machine, runs, 1.0), machine, None).best
    assert not best.misfit
    assert best.disturbances == ((Port.TORQUE, 0), (Port.RATE, 2))
    error = np.sqrt(np.diag(best.spread.covariance))
    value = dict(zip(best.vector.labels, best.theta, strict=True))
    for (name, found), std in zip(value.items(), error, strict=True):
        truth = {"pull": PULL, "drag": DRAG, "fast": decay, "decay": decay, "back": decay * BACK}[name]
        assert abs(found - truth) < 3.5 * std + 1e-3 * truth


@pytest.mark.parametrize(("effect", "label"), [("actuator_lag", "time_constant"), ("input_delay", "delay")])
@pytest.mark.parametrize("late", [4, 5])
def test_what_acts_late_before_a_node_that_settles_within_a_row_is_as_late_as_it_is(
    effect: str, label: str, late: int
) -> None:
    runs, plate = heated(effect, late), Plate()
    system = plate.with_effects(plate.make_effect(effect, {label: 0.9 * late}))
    best = fitted_at(LogLikelihood(system, runs, 1.0), system, None).best
    found = dict(zip(best.vector.labels, best.theta, strict=True))
    error = np.sqrt(np.diag(best.spread.covariance))[best.vector.labels.index(f"{effect}.{label}")]
    assert abs(found[f"{effect}.{label}"] - late) < 3.0 * error + 0.02 * late
    regression = regression_of(
        best.vector.at(best.theta), runs
    )  # the regression leaves little more than noise there
    assert regression.physics.residual(best.theta)[:, 0].std() < 0.035


def test_a_fit_follows_a_ridge_that_bends() -> None:
    # of a current that settles within a row and a voltage that is late by a part of one data show the sum of the times
    runs, decay = turns(6, 1000.0, late=3).runs, 2500.0
    start = {"pull": PULL, "drag": DRAG, "fast": decay, "decay": decay, "back": decay * BACK}
    machine = CoilMotor(values=start)
    machine = machine.with_effects(machine.make_effect("input_delay", {"delay": 0.0066}))
    best = fitted_at(LogLikelihood(machine, runs, 1.0), machine, None).best
    found = dict(zip(best.vector.labels, best.theta, strict=True))
    assert found["input_delay.delay"] == pytest.approx(0.006, abs=1e-4)
    assert found["decay"] == pytest.approx(1000.0, rel=0.1)


@pytest.mark.slow
def test_a_model_of_it_predicts() -> None:
    data = turns(4, 1000.0)
    model = nsde_torch.train(data, system=CoilMotor, model="sysid", say=False)
    errors = model.metrics["test"]
    assert errors["diverged"] == 0
    assert errors["errors"]["model"]["w"]["1"] < 0.02 * errors["errors"]["hold"]["w"]["1"]


def test_a_mass_that_turns_round_within_a_step_is_held_there() -> None:
    machine = spring("coulomb_friction")
    machine.effects[-1].set_value("size", 5.0)
    machine.effects[-1].set_value("width", 0.004)
    runs = small_runs(rubbing(0.3), 2, 20.0)
    problem = LogLikelihood(machine, runs, 1.0)
    _, about = problem.first(problem.vector.start)
    held = about.slopes[..., 1, 1][problem.space.chunks.counted]
    assert float(held.abs().max()) < 1.1  # what rubs amplifies nothing
    assert float(held.min()) < 0.1
