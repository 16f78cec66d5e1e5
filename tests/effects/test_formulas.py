"""Effects that a formula of one row says: the contract of each, and its formula by hand."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from nsde_torch.diagnosis.candidates import why_not
from nsde_torch.systems import make_system
from tests.helpers.effect_rows import flying, made, term

SPRING, CART, HEXA, QUAD = "mass_spring_damper", "cartpole", "hexacopter", "quadrotor"

# ---- inputs ------------------------------------------------------------------------------------------------


COMMANDS = [0.05, -0.3, 2.0, -2.0]


@pytest.mark.parametrize(
    ("name", "values", "acts"),
    [
        ("actuator_deadband", {"width": 0.2}, [0.0, -0.1, 1.8, -1.8]),
        ("actuator_saturation", {"level": 1.5}, [0.05, -0.3, 1.5, -1.5]),
        ("asymmetric_deadband", {"width_forward": 0.2, "width_backward": 0.5}, [0.0, 0.0, 1.8, -1.5]),
        ("asymmetric_gain", {"asymmetry": 0.1}, [0.055, -0.27, 2.2, -1.8]),
        ("asymmetric_saturation", {"level_forward": 1.5, "level_backward": 0.2}, [0.05, -0.2, 1.5, -0.2]),
        ("actuator_gain_drift", {"rate": -0.01}, [0.04, -0.24, 1.6, -1.6]),  # after 20 s
    ],
)
def test_what_acts_of_a_command(name: str, values: Mapping[str, float], acts: list[float]) -> None:
    u = torch.tensor(COMMANDS)[:, None]
    effect = made(SPRING, name, values)
    torch.testing.assert_close(u + term(effect, torch.zeros(4, 2), u, t=20.0), torch.tensor(acts)[:, None])


def test_a_loss_is_no_candidate_where_nothing_can_be_compared() -> None:
    why = why_not(make_system(CART), "actuator_efficiency_loss")
    assert why == "it compares inputs, and the machine has one"


def test_a_command_is_cut_before_the_lag() -> None:
    s = make_system(CART, effects=["actuator_lag", "actuator_saturation"])
    z = s.augment(torch.zeros(1, 4), torch.tensor([[3.0]]))
    torch.testing.assert_close(z[:, 4:], torch.tensor([[0.5]]))


# ---- forces ------------------------------------------------------------------------------------------------


DRY, DRAG, EXACT = {"size": 0.3, "width": 0.01}, {"drag": [0.1, 0.2, 0.3]}, {"atol": 1e-6, "rtol": 0.0}
WINDY = {**DRAG, "wind": [2.0, 0.0]}
LEFT, ON_ITS_SIDE = (Rotation.from_euler(axis, 90, degrees=True) for axis in "zx")


def at(*rows: list[float]) -> Tensor:
    return torch.tensor(rows)


@pytest.mark.parametrize(
    ("system", "name", "values", "x", "expected", "within"),
    [
        (SPRING, "constant_force", {"acceleration": -0.7}, at([0.3, 1.0], [-2.0, 0.0]), [[-0.7], [-0.7]], {}),
        (SPRING, "linear_spring", {"stiffness": 4.0}, at([0.5, 9.0]), [[-2.0]], {}),
        (SPRING, "cubic_stiffness", {"stiffness": 3.0}, at([-2.0, 9.0]), [[24.0]], {}),
        (CART, "viscous_friction", {"damping": 0.5}, at([9.0, -3.0, 0.0, 0.0]), [[1.5]], {}),
        # constant in motion, and gentle at rest
        (SPRING, "coulomb_friction", DRY, at([0.0, 1.0], [0.0, -1.0], [0.0, 0.0], [0.0, 0.01]),
         [[-0.3], [0.3], [0.0], [-0.3 * math.tanh(1.0)]], {}),
        (SPRING, "asymmetric_friction", {"size_forward": 0.3, "size_backward": 0.1, "width": 0.01},
         at([0.0, 1.0], [0.0, -1.0], [0.0, 0.0]), [[-0.3], [0.1], [0.0]], {}),
        # it falls from rest to speed
        (SPRING, "stribeck_friction", {"size": 0.2, "extra": 0.1, "speed": 0.5, "width": 0.001},
         at([0.0, 0.01], [0.0, 0.5], [0.0, -5.0]),
         [[-0.2 - 0.1 * math.exp(-0.0004)], [-0.2 - 0.1 * math.exp(-1.0)], [0.2]], {}),
        (CART, "quadratic_damping", {"damping": 0.5}, at([0.0, 2.0, 0.0, 0.0], [0.0, -4.0, 0.0, 0.0]),
         [[-2.0], [8.0]], {}),
        (SPRING, "position_dependent_friction", {**DRY, "slope": 0.5}, at([0.2, 1.0], [-0.2, -1.0]),
         [[-0.4], [0.2]], {}),
        # turned left by a quarter: world's +x is the body's right (-y)
        (HEXA, "linear_drag", DRAG, flying([2.0, 0.0, 1.0], LEFT), [[0.0, 0.4, -0.3]], EXACT),
        (QUAD, "quadratic_drag", {"drag": [0.1, 0.1, 0.2]}, flying([3.0, 0.0, 4.0]), [[-1.5, 0.0, -4.0]], {}),
        (QUAD, "quadratic_drag", {"drag": [0.1, 0.1, 0.2]}, flying([6.0, 0.0, 8.0]), [[-6.0, 0.0, -16.0]], {}),
        # on its side, what is up in the world lies in the plane of the rotors
        (QUAD, "translational_lift", {"lift": 0.02}, flying([3.0, 0.0, 4.0], ON_ITS_SIDE), [[0.0, 0.0, 0.5]], EXACT),
        (QUAD, "translational_lift", {"lift": 0.02}, flying([0.0, 0.0, 4.0]), [[0.0, 0.0, 0.0]], {}),
        # who flies with the wind feels none; a wind to the east comes from the left of who looks north
        (HEXA, "constant_wind", {**DRAG, "wind": [2.0, -1.0]},
         flying([2.0, -1.0, 0.0], Rotation.from_euler("z", 40, degrees=True)), [[0.0, 0.0, 0.0]], EXACT),
        (HEXA, "constant_wind", WINDY, flying([0.0, 0.0, 0.0], LEFT), [[0.0, -0.4, 0.0]], EXACT),
        (HEXA, "angular_damping", {"damping": [0.1, 0.2, 0.3]}, flying([0.0] * 3, rates=(1.0, -2.0, 3.0)),
         [[-0.1, 0.4, -0.9]], {}),
        # forward flight lifts the nose, and flight to the left the left side
        (HEXA, "flapping_moment", {"gain": [0.2, 0.3]}, flying([2.0, 1.0, 5.0]), [[0.2, -0.6, 0.0]], {}),
    ],
)  # fmt: skip
def test_what_is_added_to_the_rates(
    system: str, name: str, values: Any, x: Tensor, expected: list[list[float]], within: dict[str, float]
) -> None:
    effect = made(system, name, values)
    torch.testing.assert_close(term(effect, x), torch.tensor(expected), **within)


@pytest.mark.parametrize("t", [0.0, 0.125, 0.31])
def test_a_periodic_force_swings_with_the_clock(t: float) -> None:
    effect = made(SPRING, "periodic_force", {"sine": 0.3, "cosine": 0.4, "frequency": 2.0})
    expected = 0.3 * math.sin(4 * math.pi * t) + 0.4 * math.cos(4 * math.pi * t)
    found = term(effect, torch.zeros(1, 2), t=t)
    torch.testing.assert_close(found, torch.tensor([[expected]]), atol=1e-5, rtol=0)


def test_a_periodic_force_keeps_its_phase_on_a_clock_that_starts_far_away() -> None:
    effect = made(SPRING, "periodic_force", {"sine": 1.0, "cosine": 0.0, "frequency": 0.25})
    late = torch.tensor([4.0e6 + 1.0], dtype=torch.float64)
    value = effect(late, torch.zeros(1, 2), torch.zeros(1, 1), torch.zeros(1, 0))
    torch.testing.assert_close(value.detach(), torch.ones(1, 1))


@pytest.mark.parametrize(("thrust", "times"), [(9.81, 1.0), (4 * 9.81, 2.0), (-1.0, 0.0)])
def test_rotor_drag_is_linear_drag_at_hover_and_twice_that_at_four_times_the_thrust(
    thrust: float, times: float
) -> None:
    u = torch.cat((torch.zeros(1, 6), torch.tensor([[thrust]])), 1)
    found = term(made(HEXA, "rotor_drag", DRAG), flying([2.0, -1.0, 3.0]), u)
    torch.testing.assert_close(found, times * torch.tensor([[-0.2, 0.2, -0.9]]), atol=1e-5, rtol=0)


def test_losses_curves_and_sag_of_motors() -> None:
    level = flying([0.0, 0.0, 0.0])
    losses = made(QUAD, "motor_efficiency_loss", {"loss": [0.1, 0.2, 0.3, 0.4]})
    half = term(losses, level, torch.full((1, 4), 0.5))
    torch.testing.assert_close(half, torch.tensor([[-0.05, -0.1, -0.15, -0.2]]))
    u = torch.tensor([[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]])
    torch.testing.assert_close(term(made(HEXA, "thrust_curve", {"curvature": 2.0}), level, u), 2.0 * u**2)
    torch.testing.assert_close(u + term(made(HEXA, "thrust_sag", {"rate": 0.002}), level, u, t=50.0), 0.9 * u)
    share = 1.0 - 0.2 * u.mean()  # by what all motors draw
    torch.testing.assert_close(u + term(made(HEXA, "supply_sag", {"drop": 0.2}), level, u), share * u)


def test_a_centre_of_mass_ahead_lets_the_nose_sink() -> None:
    c, mass, inertia, thrust = np.array([0.02, 0.01, 0.0]), 2.0, 0.05, 10.0
    moment = np.cross(-c, [0.0, 0.0, mass * thrust]) / inertia
    effect = made(HEXA, "com_offset", {"offset": (c[:2] * mass / inertia).tolist()})
    u = torch.cat((torch.zeros(1, 6), torch.tensor([[thrust]])), 1)
    found = term(effect, flying([0.0, 0.0, 0.0]), u)[0]
    torch.testing.assert_close(found, torch.from_numpy(moment).float())
    assert float(found[1]) > 0  # FLU: pitch up is negative, the nose goes down here... by the rear that lifts


def test_at_half_a_metre_a_rotor_lifts_as_cheeseman_and_bennett_say() -> None:
    radius, z = 0.4, 0.5
    effect = made(HEXA, "ground_effect", {"area": (radius / 4) ** 2, "height": 1e-4})
    x, u = flying([0.0, 0.0, 0.0]), torch.cat((torch.zeros(1, 6), torch.tensor([[10.0]])), 1)
    x[0, 2] = z
    exact = 10.0 * (1 / (1 - (radius / (4 * z)) ** 2) - 1)
    assert abs(float(term(effect, x, u)[0, 2]) / exact - 1) < 0.05
