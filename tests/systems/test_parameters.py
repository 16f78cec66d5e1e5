"""Declared parameters as one vector: order, units, bounds, and a drift that is linear in them."""

import numpy as np
import pytest
import torch

from nsde_torch.errors import ConfigError
from nsde_torch.systems import make_system
from nsde_torch.systems.parameters import ParameterVector
from tests.helpers.toy_systems import Decay


def test_names_units_and_values_are_those_of_the_system_and_then_of_its_effects() -> None:
    system = make_system("hexacopter", effects=["linear_drag", "motor_lag"])
    vector = ParameterVector(system)
    assert vector.labels[0] == "thrust_gain"
    assert vector.labels[-4:] == [*(f"linear_drag.drag[{i}]" for i in range(3)), "motor_lag.time_constant"]
    assert vector.units[-4:] == ["1/s", "1/s", "1/s", "s"]
    assert [p.name for p in vector.places][-2:] == ["linear_drag.drag", "motor_lag.time_constant"]
    declared = torch.cat([value for value, _ in system.all_declared().values()])
    np.testing.assert_allclose(vector.start, declared, rtol=1e-5)
    assert (vector.low[5], vector.high[5]) == (0.3, 1.5)
    assert vector.low[1] == -np.inf
    assert vector.moves_memory.tolist() == [False] * 10 + [True]


def test_the_copy_takes_theta_and_the_system_itself_stays_as_it_is() -> None:
    system = make_system("mass_spring_damper")
    vector = ParameterVector(system)
    x = torch.tensor([[0.3, -0.2]], dtype=torch.float64)
    u = torch.tensor([[0.5]], dtype=torch.float64)
    before = system.drift(0.0, x.float(), u.float())
    vector.use(torch.tensor([2.0, 3.0, 0.25], dtype=torch.float64))
    assert float(vector.system.drift(0.0, x, u)[0, 1]) == pytest.approx(2.0 * 0.5 - 3.0 * 0.3 + 0.25 * 0.2)
    assert torch.equal(system.drift(0.0, x.float(), u.float()), before)


def test_the_drift_is_linear_in_theta_where_the_physics_is() -> None:
    vector = ParameterVector(make_system("mass_spring_damper"))
    x = torch.randn(5, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def drift(theta: torch.Tensor) -> torch.Tensor:
        vector.use(theta)
        return vector.system.drift(0.0, x, x[:, :1])

    theta = torch.tensor(vector.start)
    slopes = torch.func.jacfwd(drift)(theta)
    away = theta + torch.tensor([0.3, -0.4, 0.5])
    torch.testing.assert_close(drift(away), drift(theta) + slopes @ (away - theta))


def test_values_are_moved_strictly_inside_the_bounds_and_written() -> None:
    system = make_system("cartpole")
    vector = ParameterVector(system)
    inside = vector.inside(np.array([-1.0, 2.0, 0.7]))
    assert 0 < inside[0] < 1e-5
    assert 0.949 < inside[1] < 0.95
    vector.write(system, np.array([-1.0, 2.0, 0.7]))
    written = {name: float(value) for name, (value, _) in system.all_declared().items()}
    assert written["half_length"] == pytest.approx(0.7, rel=1e-6)
    assert written["pole_share"] == pytest.approx(0.95, abs=1e-5)


def test_values_of_effects_are_written_too() -> None:
    system = make_system("hexacopter", effects=["linear_drag"])
    vector = ParameterVector(system)
    theta = vector.start.copy()
    theta[-3:] = [0.2, 0.3, 0.4]
    vector.write(system, theta)
    drag = system.all_declared()["linear_drag.drag"][0]
    np.testing.assert_allclose(drag, [0.2, 0.3, 0.4], rtol=1e-5)


def test_a_system_without_parameters_is_refused() -> None:
    class Bare(Decay):
        name = "bare"
        PARAMETERS = {}

    with pytest.raises(ConfigError, match="declares no parameter"):
        ParameterVector(Bare())


def test_times_of_a_memory_are_kept_as_long_as_steps_can_follow() -> None:
    vector = ParameterVector(make_system("hexacopter", effects=["motor_lag"]))
    at = {label: k for k, label in enumerate(vector.labels)}
    vector.follow(0.01)
    vector.follow(0.001)  # a finer step asks for less than is asked already
    low = vector.inside(np.full(len(vector), 1e-4))
    assert low[at["motor_lag.time_constant"]] == pytest.approx(0.005, rel=1e-3)
    assert low[at["thrust_gain"]] == pytest.approx(1e-4)


def test_a_width_stays_where_it_matters_at_the_speeds_of_the_data() -> None:
    effects = ["stribeck_friction", "actuator_deadband", "input_delay"]
    vector = ParameterVector(make_system("cartpole", effects=effects))
    at = {label: k for k, label in enumerate(vector.labels)}
    before = vector.low.copy(), vector.high.copy()
    vector.limit({"speed[cart]": 2.0, "input": 25.0})
    assert vector.low[at["stribeck_friction[cart].speed"]] == pytest.approx(2.0 * 0.1 / 4)
    assert vector.high[at["stribeck_friction[cart].speed"]] == pytest.approx(2.0 * 0.3 * 4)
    assert vector.low[at["stribeck_friction[cart].width"]] == pytest.approx(2.0 * 0.02 / 4)
    others = ("actuator_deadband.width", "input_delay.delay", "stribeck_friction[cart].size", "half_length")
    for k in (at[name] for name in others):
        assert (vector.low[k], vector.high[k]) == (before[0][k], before[1][k])


def test_values_lie_inside_bounds_that_are_closer_than_the_usual_margin() -> None:
    system = make_system("mass_spring_damper", effects=["stribeck_friction"])
    vector = ParameterVector(system)
    vector.limit({"speed": 2e-9})
    width = vector.labels.index("stribeck_friction.width")
    assert vector.high[width] < 1e-6 * vector.scale[width]
    theta = vector.inside(np.full(len(vector), 1.0))
    assert vector.low[width] < theta[width] < vector.high[width]


def test_a_height_stays_near_those_that_the_effect_is_for() -> None:
    effects = ["ground_effect", "constant_wind", "motor_lag"]
    vector = ParameterVector(make_system("hexacopter", effects=effects))
    at = {label: k for k, label in enumerate(vector.labels)}
    before = vector.low.copy()
    vector.limit({"input": 0.5})
    assert vector.low[at["ground_effect.height"]] == pytest.approx(0.1 / 4)
    assert vector.high[at["ground_effect.height"]] == pytest.approx(0.3 * 4)
    for name in ("constant_wind.wind[0]", "motor_lag.time_constant", "ground_effect.area"):
        assert vector.low[at[name]] == before[at[name]]


def test_the_copy_knows_of_no_coarse_steps() -> None:
    system = make_system("cartpole", effects=["actuator_lag"])
    system.set_step(0.1)
    assert [e.step for e in ParameterVector(system).system.effects] == [0.0]
    assert [e.step for e in system.effects] == [0.1]


def test_of_losses_that_gains_can_stand_in_for_the_median_is_the_reference() -> None:
    vector = ParameterVector(make_system("quadrotor", effects=["motor_efficiency_loss", "linear_drag"]))
    theta, known = vector.start.copy(), np.ones(len(vector), dtype=np.bool_)
    losses = vector.of("motor_efficiency_loss")
    theta[losses] = [0.02, 0.1, 0.01, 0.03]
    assert vector.references(theta, known) == []
    known[losses] = False
    assert vector.references(theta, known) == [losses[0]]
    known[losses[0]] = True
    assert vector.references(theta, known) == []
