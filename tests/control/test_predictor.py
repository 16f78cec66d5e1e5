"""One step of a model as the controller has it."""

from copy import deepcopy

import pytest
import torch

from nsde_torch.control.predictor import Predictor
from nsde_torch.errors import ConfigError
from nsde_torch.models import EnsembleSpec, GaussianEnsemble, NeuralSDE, SDESpec
from nsde_torch.systems import Hexacopter, System


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


def test_a_model_that_is_none_but_networks_takes_its_own_step() -> None:
    spec = SDESpec("hexacopter", kind="blackbox_nsde", dt=0.05, horizon=20, step="milstein", physics=False)
    made = NeuralSDE(spec, generator=torch.Generator().manual_seed(0))
    x, u = _rows(5)
    predictor = Predictor(made, dt=0.05, dtype=torch.float64)
    wanted = predictor.system.project(x + 0.05 * predictor.drift(x, u, torch.zeros(5, 0).double()))
    assert torch.equal(predictor(x, u, torch.zeros(5, 0).double()), wanted)


def test_steps_are_in_physical_seconds_whatever_the_clock_of_the_log(model: NeuralSDE) -> None:
    x, u = _rows(3)
    slow, none = deepcopy(model), torch.zeros(3, 6).double()
    slow.clock_scale.fill_(1.06)
    found = [Predictor(made, dt=0.05, dtype=torch.float64)(x, u, none) for made in (model, slow)]
    assert torch.equal(*found)


def test_a_push_is_an_acceleration_in_body_axes(declared: System) -> None:
    predictor = Predictor(declared, dt=0.01, dtype=torch.float64)
    x = torch.zeros(1, 13, dtype=torch.float64)
    x[:, 6] = 1.0
    u, none = torch.full((1, 6), 0.4).double(), torch.zeros(1, 6).double()
    push = torch.tensor([[1.0, 2.0, 3.0, 0.1, 0.2, 0.3]]).double()
    change = predictor.drift(x, u, push) - predictor.drift(x, u, none)
    assert torch.allclose(change[0, [3, 4, 5, 10, 11, 12]], push[0])


def test_a_predictor_does_not_touch_the_model(model: NeuralSDE) -> None:
    before = {k: v.clone() for k, v in model.state_dict().items()}
    Predictor(model, dt=0.02, dtype=torch.float64)
    after = model.state_dict()
    assert all(torch.equal(before[k], v) for k, v in after.items())
    assert {k: v.dtype for k, v in after.items()} == {k: v.dtype for k, v in before.items()}


def test_models_without_a_drift_are_refused_with_the_choices() -> None:
    spec = EnsembleSpec("hexacopter", dt=0.05, horizon=20)
    with pytest.raises(ConfigError, match="nsde, node"):
        Predictor(GaussianEnsemble(spec, generator=torch.Generator()), dt=0.05)


def test_effects_that_read_logged_channels_cannot_be_planned_with() -> None:
    with pytest.raises(ConfigError, match="battery_voltage"):
        Predictor(Hexacopter(["battery_voltage"]), dt=0.05)
