"""What networks see of a state and predict of its change: full turns and signs of quaternions make no difference."""

import math

import pytest
import torch

from nsde_torch.models.ensemble import Chart
from nsde_torch.systems import make_system

SYSTEMS = ("mass_spring_damper", "cartpole", "hexacopter", "quadrotor")


def states(name: str, n: int = 64, seed: int = 0) -> torch.Tensor:
    system = make_system(name)
    x = torch.randn(n, system.nx, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return system.double().project(x)


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_state_moved_by_its_change_is_the_other_state(name: str) -> None:
    system = make_system(name).double()
    chart = Chart(system)
    x, after = states(name), states(name, seed=1)
    assert chart.inputs(x).shape == (64, chart.width)
    before = x.clone(), after.clone()
    change = chart.change(x, after)
    assert change.shape == (64, chart.n_change)
    assert float(system.error(chart.moved(x, change), after).abs().max()) <= 1e-9
    assert torch.equal(x, before[0])
    assert torch.equal(after, before[1])


def test_the_angle_of_the_cartpole_is_found_and_a_full_turn_is_not_seen() -> None:
    chart = Chart(make_system("cartpole"))
    assert chart.angles == [2]
    x, after = states("cartpole"), states("cartpole", seed=1)
    turned, turned_after = x.clone(), after.clone()
    turned[:, 2] += 2 * math.pi
    turned_after[:, 2] -= 4 * math.pi
    torch.testing.assert_close(chart.inputs(turned), chart.inputs(x))
    torch.testing.assert_close(chart.change(turned, turned_after), chart.change(x, after))
    assert bool((chart.change(x, after)[:, 2].abs() <= math.pi).all())


@pytest.mark.parametrize("name", ["mass_spring_damper", "hexacopter"])
def test_no_angle_is_seen_where_there_is_none(name: str) -> None:
    assert Chart(make_system(name)).angles == []


def test_the_sign_of_a_quaternion_is_not_seen_and_its_change_is_a_rotation_vector() -> None:
    system = make_system("hexacopter").double()
    chart = Chart(system)
    x, after = states("hexacopter"), states("hexacopter", seed=1)
    other, other_after = x.clone(), after.clone()
    other[:, 6:10] *= -1
    torch.testing.assert_close(chart.inputs(other), chart.inputs(x))
    torch.testing.assert_close(chart.change(other, other_after), chart.change(x, after))
    torch.testing.assert_close(chart.change(x, after), system.error(after, x))
