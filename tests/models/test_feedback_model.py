"""Logged inputs tell what disturbed the machine: the controller is found, and what paths make of it is Bayes' rule."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import nsde_torch
from nsde_torch.data import Run
from nsde_torch.errors import ConfigError
from nsde_torch.models import NeuralSDE, SDESpec
from nsde_torch.models.feedback_model import FeedbackModel, fit_feedback
from nsde_torch.training.session import learn_feedback
from tests.helpers.toy_systems import DT, Gusty, fix_sigma, make_model

SIGMA, SIGMA_D, TAU, SIGMA_U = 0.2, 2.0, 0.6, 0.2
LAW = (-3.0, 1.0, 0.3, 0.1)  # of x_k, x_{k-1}, u_{k-1}, 1

Array = NDArray[np.float64]


def gusty() -> NeuralSDE:
    """x' = -x + u + d with known noise."""
    made = make_model(Gusty, dtype=torch.float64, disturbance=True)
    model = fix_sigma(made, torch.tensor([SIGMA, SIGMA_D]))
    with torch.no_grad():
        model.log_tau.fill_(float(np.log(TAU - 2 * DT)))
    return model.requires_grad_(False)


def flown(steps: int, seed: int, law: tuple[float, ...] = LAW) -> tuple[Array, Array]:
    """States (n + 1,) and inputs (n,) of the controlled machine, by the scheme of Euler and Maruyama."""
    rng = np.random.default_rng(seed)
    x, d, past = 0.3, rng.standard_normal() * SIGMA_D * (TAU / 2) ** 0.5, (0.3, 0.0)
    xs, us = [x], []
    for _ in range(steps):
        u = law[0] * x + law[1] * past[0] + law[2] * past[1] + law[3] + SIGMA_U * rng.standard_normal()
        past = (x, u)
        x, d = (
            x + DT * (-x + u + d) + SIGMA * DT**0.5 * rng.standard_normal(),
            d - DT * d / TAU + SIGMA_D * DT**0.5 * rng.standard_normal(),
        )
        xs.append(x)
        us.append(u)
    return np.array(xs), np.array(us)


def posterior(x0: float, u: Array) -> tuple[float, float]:
    """Mean and deviation of the last state given x_0 and the inputs, by conditioning all normal numbers at once."""
    n = len(u)
    size = 1 + 2 * n  # of the first disturbance and of the noise of each step
    known, moved = np.zeros((n + 1, 2)), np.zeros((n + 1, 2, size))
    known[0] = x0, 0.0
    moved[0, 1, 0] = SIGMA_D * (TAU / 2) ** 0.5
    f = np.array([[1 - DT, DT], [0.0, 1 - DT / TAU]])
    for k in range(n):
        known[k + 1] = f @ known[k] + (DT * u[k], 0.0)
        moved[k + 1] = f @ moved[k]
        moved[k + 1, 0, 1 + 2 * k] += SIGMA * DT**0.5
        moved[k + 1, 1, 2 + 2 * k] += SIGMA_D * DT**0.5
    x = known[:, 0]
    told = [u[k] - LAW[0] * x[k] - LAW[1] * x[k - 1] - LAW[2] * u[k - 1] - LAW[3] for k in range(1, n)]
    seen = np.array([LAW[0] * moved[k, 0] + LAW[1] * moved[k - 1, 0] for k in range(1, n)])
    inverse = np.linalg.inv(seen @ seen.T + SIGMA_U**2 * np.eye(n - 1))
    last = moved[n, 0]
    mean = known[n, 0] + last @ seen.T @ inverse @ np.array(told)
    return float(mean), float(np.sqrt(last @ last - last @ seen.T @ inverse @ seen @ last))


def test_paths_under_replayed_inputs_have_the_distribution_given_these_inputs() -> None:
    model = gusty()
    made = FeedbackModel(1, 1, 1).double()
    made.weights.copy_(torch.tensor(LAW, dtype=torch.float64)[:, None])
    made.covariance.fill_(SIGMA_U**2)
    model.feedback, model.spec = made, replace(model.spec, feedback=1)
    steps, particles = 30, 6000
    flights = [flown(steps, seed) for seed in range(4)]
    x0 = torch.tensor([[x[0]] for x, _ in flights])
    u = torch.tensor(np.array([u for _, u in flights]))[..., None]
    given = {"dt": DT, "particles": particles, "generator": torch.Generator().manual_seed(0)}
    read = model.sample(x0, u, replayed=True, **given)[:, :, -1, 0]
    blind = model.sample(x0, u, **given)[:, :, -1, 0]
    for b, (x, inputs) in enumerate(flights):
        mean, deviation = posterior(float(x[0]), inputs)
        assert float(read[:, b].mean()) == pytest.approx(mean, abs=0.07 * deviation)
        assert float(read[:, b].std()) == pytest.approx(deviation, rel=0.05)
        assert float(blind[:, b].std()) > 1.8 * deviation  # inputs tell most of it


def test_the_controller_of_the_runs_is_found_at_the_step_of_the_model_and_at_a_finer_one() -> None:
    model, law = gusty(), np.array(LAW)
    x, u = flown(40000, 1)
    run = Run("run_0", DT * np.arange(len(u)), x[:-1, None], u[:, None])
    found = fit_feedback(model, [run], 1)
    np.testing.assert_allclose(found.weights[:, 0], law, atol=0.08)
    assert float(found.covariance) == pytest.approx(SIGMA_U**2, rel=0.03)
    x2, u2 = (np.repeat(column[:, None], 2, 0) for column in (x[:-1], u))
    held = Run("run_0", DT / 2 * np.arange(2 * len(u)), x2, u2)
    finer = fit_feedback(model, [held], 1)
    assert float(finer.covariance) < 1.05 * SIGMA_U**2


@pytest.mark.parametrize("closed", [True, False])
def test_it_is_kept_where_it_makes_predictions_of_the_training_runs_better(closed: bool) -> None:
    model = gusty()
    model.spec = replace(model.spec, feedback=3)
    x, u = flown(3000, 2, LAW if closed else (0.0, 0.0, 0.8, 0.0))
    run = Run("run_0", DT * np.arange(len(u)), x[:-1, None], u[:, None])
    found = learn_feedback(model, [run], seed=0)
    assert found["kept"] == model.capabilities.knows_feedback == closed
    assert (model.spec.feedback > 0) == closed
    if closed:
        assert found["crps"] < -0.1
    still = Run("run_0", DT * np.arange(len(u)), x[:-1, None], np.zeros((len(u), 1)))
    assert fit_feedback(model, [still], 3) is None
    short = gusty()
    short.spec = replace(short.spec, feedback=3)
    few = Run("run_0", DT * np.arange(9), x[:9, None], u[:9, None])
    assert learn_feedback(short, [few], seed=0) == {"kept": False}


def test_an_evaluation_reads_logged_inputs_or_not() -> None:
    options: dict[str, Any] = {"step": "euler_maruyama", "sigma_max": (0.0, 0.3), "feedback": 1}
    spec = SDESpec("mass_spring_damper", dt=0.02, horizon=10, **options)
    model = NeuralSDE(spec, generator=torch.Generator().manual_seed(0)).requires_grad_(False)
    made = nsde_torch.simulate("mass_spring_damper", durations=[3.0, 3.0], seed=1)
    data = nsde_torch.read(made, system="mass_spring_damper")
    model.feedback = fit_feedback(model, data.runs, 1) or FeedbackModel(2, 1, 1)
    given: dict[str, Any] = {"particles": 9, "bootstrap": 100, "say": False}
    logged = nsde_torch.evaluate(model, data, **given)
    blind = nsde_torch.evaluate(model, data, inputs="set", **given)
    assert "predictions read from the logged inputs" in logged.report
    assert "predictions read from the logged inputs" not in blind.report
    assert model.capabilities.knows_feedback
    assert logged.errors != blind.errors
    with pytest.raises(ConfigError, match="`inputs` must be logged or set; got 'given'"):
        nsde_torch.evaluate(model, data, inputs="given", **given)  # type: ignore[arg-type]
