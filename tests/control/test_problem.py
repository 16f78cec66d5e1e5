"""One step of a model as the controller has it, and costs of plans."""

from math import cos, sin

import pytest
import torch

from nsde_torch.control.options import STATE_WEIGHTS, ProblemOptions
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.problem import Residual, attitude_error
from nsde_torch.control.reference import Reference
from nsde_torch.errors import ConfigError
from nsde_torch.models import NeuralSDE
from nsde_torch.systems import Cartpole, Hexacopter, System
from tests.helpers.control_problems import horizon_of, problem_of


def _level(n: int = 1) -> torch.Tensor:
    x = torch.zeros(n, 13, dtype=torch.float64)
    x[:, 6] = 1.0
    return x


def test_the_attitude_error_is_the_vector_part_of_q_times_the_inverse_reference() -> None:
    c, s, half = cos(0.15), sin(0.15), 0.5**0.5
    q, level = torch.tensor([[c, 0.0, 0.0, s]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    assert torch.allclose(attitude_error(q, level), torch.tensor([[0.0, 0.0, s]]))
    assert torch.allclose(attitude_error(-q, level), attitude_error(q, level))
    # of a reference that is turned too, the error is in the world's axes
    tilt, product = torch.tensor([[half, half, 0.0, 0.0]]), half * torch.tensor([[c, c, s, s]])
    assert torch.allclose(attitude_error(product, tilt), attitude_error(q, level), atol=1e-6)


def test_the_cost_is_the_supplements_sum(declared: System, path: Reference) -> None:
    h = horizon_of(declared)
    p = problem_of(h, path, rows=2)
    u = torch.rand(2, 20, 6, generator=torch.Generator().manual_seed(0)).double()
    z = h.rollout(p.z0, u, p.d)
    total = 0.0
    for k in range(20):
        x, r = z[1, 0, k + 1], p.ref[1, k]
        e = torch.cat((x[:6] - r[:6], attitude_error(x[None, 6:10], r[None, 6:10])[0], x[10:] - r[10:]))
        total += float((torch.tensor(STATE_WEIGHTS) * e * e).sum() + (u[1, k] ** 2).sum())
    assert float(h.cost(z, u, p.ref, p.last)[1]) == pytest.approx(total)


@pytest.mark.parametrize(
    ("options", "column", "value", "excess"),
    [
        ({"speed_limit": 2.0}, 3, 2.5, 0.5),
        ({"fence": ((-1.0, 1.0), (-1.0, 1.0), (0.0, 2.0))}, 0, 1.2, 0.2),
        ({"fence": ((-1.0, 1.0), (-1.0, 1.0), (0.5, 2.0))}, 2, 0.3, 0.2),
    ],
)
def test_soft_limits_cost_nothing_inside_and_the_square_of_the_excess_outside(
    declared: System, options: dict[str, object], column: int, value: float, excess: float
) -> None:
    predictor = Predictor(declared, dt=0.05, dtype=torch.float64)
    residual = Residual(predictor, ProblemOptions(state_weights=(0.0,) * 12, **options))  # type: ignore[arg-type]
    x = _level()
    x[:, 2] = 1.0
    assert float(residual(x, x).square().sum()) == 0.0
    x[:, column] = value
    assert float(residual(x, x).square().sum()) == pytest.approx(100.0 * excess**2, rel=1e-3)


def test_tilt_beyond_its_limit_costs(declared: System) -> None:
    options = ProblemOptions(state_weights=(0.0,) * 12, tilt_limit=30.0)
    residual = Residual(Predictor(declared, dt=0.05, dtype=torch.float64), options)
    x = _level(2)
    for row, degrees in enumerate((29.0, 40.0)):
        half = torch.deg2rad(torch.tensor(0.5 * degrees))
        x[row, 6], x[row, 7] = torch.cos(half), torch.sin(half)
    inside, outside = residual(x, x).square().sum(1)
    assert float(inside) == 0.0
    assert float(outside) > 1.0


def test_ignorance_costs_where_the_model_knows_of_it(model: NeuralSDE, declared: System) -> None:
    weighted = Residual(Predictor(model, dt=0.05), ProblemOptions(uncertainty_weight=50.0))
    x = _level().float()
    eta = float(model.distance(x))
    assert float(weighted(x, x).square().sum()) == pytest.approx(50.0 * eta**2, rel=1e-4)
    with pytest.raises(ConfigError, match="uncertainty_weight"):
        Residual(Predictor(declared, dt=0.05), ProblemOptions(uncertainty_weight=1.0))


def test_the_expectation_is_over_paths_with_the_models_noise(model: NeuralSDE, path: Reference) -> None:
    one, many = horizon_of(model), horizon_of(model, particles=8)
    p = problem_of(many, path, rows=2)
    u = torch.full((2, 20, 6), 0.41).double()
    z = many.rollout(p.z0, u, p.d)
    assert z.shape == (2, 8, 21, 13)
    assert float(z[0, :, -1, 3:6].std(0).min()) > 1e-3
    each = [one.cost(z[:, k : k + 1], u, p.ref, p.last) for k in range(8)]
    assert torch.allclose(many.cost(z, u, p.ref, p.last), torch.stack(each).mean(0))


def test_another_machine_needs_weights_of_its_own_and_has_no_limits_of_a_flight() -> None:
    predictor = Predictor(Cartpole(), dt=0.05)
    with pytest.raises(ConfigError, match="takes 4 numbers"):
        Residual(predictor, ProblemOptions())
    with pytest.raises(ConfigError, match="for multirotors"):
        Residual(predictor, ProblemOptions(state_weights=(1.0,) * 4, tilt_limit=30.0))
    with pytest.raises(ConfigError, match="a pair for each of x, theta"):
        Residual(predictor, ProblemOptions(state_weights=(1.0,) * 4, fence=((-1.0, 1.0),)))


def _rows(n: int) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(1)
    x = torch.randn(n, 13, generator=g, dtype=torch.float64)
    x[:, 6:10] = torch.nn.functional.normalize(x[:, 6:10], dim=1)
    return x, torch.rand(n, 6, generator=g, dtype=torch.float64)


def _error(system: System, dt: float) -> tuple[float, float]:
    """Largest error of position, velocity and attitude after a step and after Euler's, by the method of order four."""
    x, u = _rows(20)
    u = 0.4 + 0.05 * u
    z = system.double().augment(x, u)
    none = torch.zeros(20, 6).double()
    exact = Predictor(system, dt=dt, dtype=torch.float64)
    drift = exact.drift(z, u, none)
    k2 = exact.drift(z + 0.5 * dt * drift, u, none)
    k3 = exact.drift(z + 0.5 * dt * k2, u, none)
    k4 = exact.drift(z + dt * k3, u, none)
    wanted = system.project(z + dt / 6.0 * (drift + 2.0 * (k2 + k3) + k4))
    step, euler = exact(z, u, none), system.project(z + dt * drift)
    return tuple(float((out - wanted)[:, :10].abs().max()) for out in (step, euler))  # type: ignore[return-value]


def test_a_step_of_a_multirotor_is_of_second_order_where_eulers_is_of_first(declared: System) -> None:
    large, first = _error(declared, 0.02)
    small, second = _error(declared, 0.01)
    assert small < 0.15 * large  # errors of one step: h^3 and h^2
    assert second > 0.2 * first
    assert large < 0.1 * first


def test_a_push_is_an_acceleration_in_body_axes(declared: System) -> None:
    predictor = Predictor(declared, dt=0.01, dtype=torch.float64)
    x = torch.zeros(1, 13, dtype=torch.float64)
    x[:, 6] = 1.0
    u, none = torch.full((1, 6), 0.4).double(), torch.zeros(1, 6).double()
    push = torch.tensor([[1.0, 2.0, 3.0, 0.1, 0.2, 0.3]]).double()
    change = predictor.drift(x, u, push) - predictor.drift(x, u, none)
    assert torch.allclose(change[0, [3, 4, 5, 10, 11, 12]], push[0])


def test_effects_that_read_logged_channels_cannot_be_planned_with() -> None:
    with pytest.raises(ConfigError, match="battery_voltage"):
        Predictor(Hexacopter(["battery_voltage"]), dt=0.05)
