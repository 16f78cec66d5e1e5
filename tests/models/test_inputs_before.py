"""`u_before`: lags and delays begin where the log had them, for every kind of model."""

import numpy as np
import pytest
import torch
from torch import Tensor

from nsde_torch.data import Run, Windows
from nsde_torch.errors import NonFiniteError, ShapeError
from nsde_torch.evaluation.scores import rollout_squares, score
from nsde_torch.models import (
    IdentifiedModel,
    Model,
    NeuralSDE,
    SDESpec,
    SysidSpec,
)
from nsde_torch.models.networks import InputFilter
from nsde_torch.simulation.plant import Plant
from nsde_torch.systems import make_system

DT, BEFORE, AHEAD = 0.02, 25, 15
VALUES = {
    "motor_lag": {"motor_lag.time_constant": 0.05, "roll_gain": 90.0},
    "input_delay": {"input_delay.delay": 0.05, "roll_gain": 90.0},
}


def flight(effect: str) -> tuple[Tensor, Tensor]:
    """States (T + 1, nx) and held commands (T, nu) of a plant whose effect carries memory, from rest."""
    system = make_system("hexacopter", effects=[effect], values=VALUES[effect])
    plant = Plant(system, dt=DT, step=0.001, generator=torch.Generator())
    x0 = torch.zeros(1, 13, dtype=torch.float64)
    x0[0, 6] = 1.0
    g = torch.Generator().manual_seed(0)
    u = 0.35 + 0.02 * torch.randn(10, 6, generator=g, dtype=torch.float64).repeat_interleave(5, 0)
    x = [plant.reset(x0, u[:1])] + [plant.step(row[None]) for row in u]
    return torch.cat(x), u


def identified(effect: str) -> IdentifiedModel:
    spec = SysidSpec("hexacopter", dt=DT, horizon=AHEAD, effects=(effect,))
    made = IdentifiedModel(spec, generator=torch.Generator(), values=VALUES[effect])
    return made.double().requires_grad_(False)


def neural(effect: str) -> Model:
    """A neural SDE that has learned nothing beside the physics, with next to no diffusion."""
    spec = SDESpec(
        "hexacopter", dt=DT, horizon=AHEAD, step="milstein_heun", effects=(effect,), sigma_max=(1e-9,) * 13
    )
    made = NeuralSDE(spec, generator=torch.Generator().manual_seed(0), values=VALUES[effect]).double()
    with torch.no_grad():
        for network in made.residuals.values():
            network.layers[-1].weight.zero_()  # type: ignore[union-attr, operator, index]
    return made.requires_grad_(False)


def sample(model: Model, x0: Tensor, u: Tensor, **more: object) -> Tensor:
    g = torch.Generator().manual_seed(1)
    return model.sample(x0, u, dt=DT, particles=2, generator=g, measurement=False, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("make", [identified, neural])
@pytest.mark.parametrize("effect", ["motor_lag", "input_delay"])
@pytest.mark.slow
def test_a_prediction_from_the_middle_of_a_flight_is_the_flight(make: object, effect: str) -> None:
    x, u = flight(effect)
    model = make(effect)  # type: ignore[operator]
    start, ahead, before = x[BEFORE : BEFORE + 1], u[None, BEFORE : BEFORE + AHEAD], u[None, :BEFORE]
    truth = x[BEFORE : BEFORE + AHEAD + 1]

    def error(**more: object) -> float:
        return float((sample(model, start, ahead, **more)[0, 0] - truth).abs().max())

    assert error(u_before=before) < 1e-3
    assert error(u_before=before[:, -20:]) < 1.1e-3  # 0.4 s suffice
    assert error() > 0.1


def test_inputs_before_are_restored_with_those_that_follow() -> None:
    spec = SDESpec("hexacopter", dt=DT, horizon=10, step="milstein", filter_reach=2, effects=("motor_lag",))
    model = NeuralSDE(spec, generator=torch.Generator().manual_seed(0)).double().requires_grad_(False)
    model.filter.weights.normal_(generator=torch.Generator().manual_seed(1))
    x, u = flight("motor_lag")
    x0, logged, before = x[BEFORE : BEFORE + 1], u[None, BEFORE : BEFORE + 10], u[None, BEFORE - 10 : BEFORE]
    restored = model.applied_inputs(u[None, BEFORE - 10 : BEFORE + 10], DT)
    expected = sample(model, x0, restored[:, 10:], u_before=restored[:, :10], applied=True)
    torch.testing.assert_close(sample(model, x0, logged, u_before=before), expected)
    assert not torch.allclose(expected, sample(model, x0, logged, u_before=before, applied=True))
    # the first input is restored from what was before it, and not from itself held
    assert not torch.allclose(restored[:, 10], model.applied_inputs(logged, DT)[:, 0])


def test_every_rollout_that_is_scored_begins_with_the_inputs_before_its_window() -> None:
    x, u = flight("motor_lag")
    run = Run("a", DT * np.arange(len(x)), x.numpy(), torch.cat((u, u[-1:])).numpy())
    windows = Windows([run], DT, 10, dtype=torch.float64)
    model, starts = identified("motor_lag"), torch.arange(25, len(windows), 4)
    scores = score(model, windows, starts, [5, 10], seed=0, particles=3)
    assert float(scores.squares.max()) < 1e-6
    assert float(rollout_squares(model, windows, starts, [5, 10]).max()) < 1e-6
    x, u, _ = windows.batch(starts)
    stationary = model.sample(x[:, 0], u, dt=DT, particles=1, generator=torch.Generator())
    assert float((stationary[0] - x).square().max()) > 1e-2


@pytest.mark.parametrize(
    ("u_before", "error", "words"),
    [
        ([[0.3] * 6], ShapeError, "`u_before` must be a real torch.Tensor or None; got list"),
        (torch.zeros(1, 6), ShapeError, r"must be \(batch, steps, nu=6\); .* Add an axis of steps"),
        (torch.zeros(1, 4, 5), ShapeError, r"`u_before` must be \(batch, steps, nu=6\); got \(1, 4, 5\)"),
        (torch.zeros(2, 4, 6), ShapeError, "`x0` has 1 rows and `u_before` has 2"),
        (torch.zeros(1, 0, 6), ShapeError, "`u_before` must hold at least one step"),
        (torch.full((1, 4, 6), torch.nan), NonFiniteError, r"`u_before` is not finite in rows \[0\]"),
    ],
)
def test_inputs_before_that_do_not_fit_are_refused(
    u_before: Tensor, error: type[Exception], words: str
) -> None:
    model = neural("motor_lag")
    x0 = torch.zeros(1, 13)
    x0[:, 6] = 1.0
    with pytest.raises(error, match=words):
        sample(model, x0, torch.full((1, 3, 6), 0.3), u_before=u_before)


def inputs(batch: int, horizon: int, seed: int = 0, n: int = 2) -> Tensor:
    return torch.randn(batch, horizon, n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def make_filter(reach: int, dt: float = 0.05, seed: int | None = 0) -> InputFilter:
    made = InputFilter(reach, dt).double().requires_grad_(False)
    if seed is not None:
        made.weights.normal_(generator=torch.Generator().manual_seed(seed))
    return made


@pytest.mark.parametrize("dt", [0.05, 0.02, 0.1])
def test_constants_pass_unchanged_whatever_the_weights(dt: float) -> None:
    u = torch.tensor([0.3, -2.0], dtype=torch.float64).expand(2, 15, 2)
    torch.testing.assert_close(make_filter(4)(u, dt), u)


def test_inside_a_window_it_is_the_stated_sum() -> None:
    made, u = make_filter(2), inputs(1, 12)
    w = made.weights - made.weights.mean()
    for k in range(2, 10):
        expected = u[0, k] + sum(w[j + 2] * u[0, k + j] for j in range(-2, 3))
        torch.testing.assert_close(made(u, 0.05)[0, k], expected)
