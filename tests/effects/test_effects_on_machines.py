"""Effects whose formula is seen in the motion of their machine: what each does to it."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from nsde_torch.systems import make_system
from nsde_torch.systems.machines import plant_effects
from tests.helpers.effect_contract import contract
from tests.helpers.effect_rows import flying, machine_with, made, term

LEVEL = flying([0.0, 0.0, 0.0])

# ---- cart and pole -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 0.7, math.pi])
def test_a_tilted_track_moves_cart_and_pole_alike(angle: float) -> None:
    x, u = torch.tensor([[0.0, 0.3, angle, 0.5]]), torch.zeros(1, 1)
    level = make_system("cartpole").drift(0.0, x, u)
    tilted = machine_with("cartpole", "track_tilt", {"slope": 0.02}).drift(0.0, x, u)
    torch.testing.assert_close((tilted - level).detach(), torch.tensor([[0.0, -9.8 * 0.02, 0.0, 0.0]]))


@pytest.mark.parametrize("angle", [0.0, 0.7, math.pi])
def test_with_a_biased_encoder_the_pole_moves_as_at_the_angle_that_it_has(angle: float) -> None:
    u = torch.full((1, 1), 3.0)
    true, read = (torch.tensor([[0.1, 0.3, a, 0.5]]) for a in (angle, angle + 0.05))
    sound = make_system("cartpole").drift(0.0, true, u)
    older = {"effects": ["angle_bias"], "values": {"angle_bias.bias": 0.05}}  # its name before
    biased = make_system("cartpole", **older)
    torch.testing.assert_close(biased.drift(0.0, read, u).detach(), sound.detach())


def test_excess_of_gravity_is_what_another_gravity_does_to_the_pole() -> None:
    x, u = torch.tensor([[0.1, 0.3, 0.7, 0.5]]), torch.full((1, 1), 3.0)
    heavier = machine_with("cartpole", "gravity", {"excess": 3.0 * 0.01 / (4.0 * 0.25)}, half_length=0.25)
    sound = make_system("cartpole", values={"half_length": 0.25})
    # of gravity, force and squared speeds scaled alike, all accelerations are
    share = 9.81 / 9.8
    slower = x * torch.tensor([[1.0, 1.0, 1.0, share**-0.5]])
    expected = share * sound.drift(0.0, slower, u / share)[:, [1, 3]]
    torch.testing.assert_close(heavier.drift(0.0, x, u)[:, [1, 3]].detach(), expected.detach())


# ---- multirotors -------------------------------------------------------------------------------------------


def test_rotor_drag_stands_in_for_linear_drag() -> None:
    before, after = (plant_effects("hexacopter", effects=e) for e in ([], ["rotor_drag"]))
    assert after["rotor_drag"] == before["linear_drag"]
    assert "linear_drag" not in after


def test_a_tracked_point_has_what_turning_adds_to_the_acceleration_of_a_point() -> None:
    offset, rate, faster = (np.array(v) for v in ([0.03, -0.02, 0.05], [1.0, -2.0, 0.5], [8.0, 3.0, -4.0]))

    def velocity(t: float) -> np.ndarray:
        """Of the point about the centre, in the axes of the start: to the second order in time."""
        turned = Rotation.from_rotvec(rate * t + 0.5 * faster * t * t)
        return turned.apply(np.cross(rate + faster * t, offset))

    expected = (velocity(1e-4) - velocity(-1e-4)) / 2e-4
    x = flying([0.0, 0.0, 0.0], Rotation.from_euler("xyz", [20, -30, 70], degrees=True))
    x[0, 10:13] = torch.tensor(rate)
    u = torch.cat((torch.zeros(1, 6), torch.tensor(faster, dtype=torch.float32)[None]), 1)
    ours = term(made("hexacopter", "tracked_point", {"offset": offset.tolist()}), x, u)
    np.testing.assert_allclose(ours.detach().numpy()[0], expected, atol=1e-5)


def test_a_force_of_the_world_pushes_alike_at_every_attitude() -> None:
    x, u, _ = contract("constant_world_force", "hexacopter")().rows(5)
    still, pushed = (
        machine_with("hexacopter", "constant_world_force", {"acceleration": c}).double().drift(0.0, x, u)
        for c in ([0.0, 0.0, 0.0], [0.1, -0.2, 0.3])
    )
    expected = torch.tensor([0.1, -0.2, 0.3]).double().expand(5, 3)
    torch.testing.assert_close((pushed - still)[:, 3:6].detach(), expected, atol=1e-6, rtol=0)


def test_ground_effect_reads_the_thrust_and_acts_along_the_body() -> None:
    s = machine_with("hexacopter", "ground_effect", {"area": 0.02, "height": 0.2}, thrust_gain=5.0)
    x, u = flying([0.0, 0.0, 0.0], Rotation.from_euler("y", 90, degrees=True)), torch.full((1, 6), 0.4)
    x[0, 2] = 0.4
    acceleration = s.drift(0.0, x, u)[0, 3:6].detach()
    expected = torch.tensor([12.0 * (1 + 0.02 / (0.16 + 0.04)), 0.0, -9.81])
    torch.testing.assert_close(acceleration, expected, atol=1e-4, rtol=0)


def test_of_a_tilted_thrust_a_share_points_sideways() -> None:
    s = machine_with("quadrotor", "thrust_misalignment", {"tilt": [0.01, -0.02]}, thrust_gain=5.0)
    acceleration = s.drift(0.0, LEVEL, torch.full((1, 4), 0.5))[0, 3:6].detach()
    torch.testing.assert_close(acceleration, torch.tensor([0.1, -0.2, 10.0 - 9.81]), atol=1e-5, rtol=0)


def test_the_gyroscopic_moment_is_the_rate_of_change_of_the_angular_momentum_of_the_rotors() -> None:
    # a rotor that spins with +z turns the body by -z: the yaw sign of its motor is -1
    commands, rates, full = np.array([0.2, 0.3, 0.6, 0.7]), np.array([0.5, -1.0, 2.0]), [2.0, 2.5]
    momentum = np.array([0.0, 0.0, -(np.array([-1.0, -1.0, 1.0, 1.0]) * commands**0.5).sum()])
    expected = torch.from_numpy(-np.cross(rates, momentum) * [*full, 0.0]).float()
    s = machine_with("quadrotor", "gyroscopic_moment", {"momentum": full})
    x, u = flying([0.0, 0.0, 0.0], rates=(0.5, -1.0, 2.0)), torch.from_numpy(commands).float()[None]
    change = s.drift(0.0, x, u) - type(s)().drift(0.0, x, u)
    torch.testing.assert_close(change[0, 10:].detach(), expected, atol=1e-5, rtol=0)


def test_products_of_inertia_are_eulers_equation_with_the_full_matrix_to_first_order() -> None:
    small = np.array([2e-3, -1e-3, 1.5e-3])  # J_xy, J_xz, J_yz over J_zz
    x, u, _ = contract("inertia_coupling", "hexacopter")().rows(5)
    u = u[:, :6]
    s = machine_with("hexacopter", "inertia_coupling", {"product": small.tolist()}).double()
    jx, jy = (float(s.value(k).detach()) for k in ("inertia_x", "inertia_y"))
    d = np.diag([jx, jy, 1.0])
    p = np.array([[0, small[0], small[1]], [small[0], 0, small[2]], [small[1], small[2], 0]])
    found = s.drift(0.0, x, u)[:, 10:].detach().numpy()
    plain = type(s)(declared=[]).double().drift(0.0, x, u)[:, 10:].detach().numpy()
    for k, omega in enumerate(x[:, 10:].numpy()):
        moment = d @ plain[k] + np.cross(omega, d @ omega)
        exact = np.linalg.solve(d + p, moment - np.cross(omega, (d + p) @ omega))
        change = np.abs(exact - plain[k]).max()
        np.testing.assert_allclose(found[k], exact, atol=0.02 * change)


@pytest.mark.parametrize("turn", [[0.02, -0.05, 0.03], [0.0, 0.0, 1.2]])
def test_a_turned_frame_is_the_same_machine_in_other_axes(turn: list[float]) -> None:
    values = {"inertia_x": 0.6, "inertia_y": 0.9}
    own = make_system("hexacopter", values=values).double()
    other = machine_with("hexacopter", "frame_misalignment", {"turn": turn}, **values).double()
    x, u, _ = contract("frame_misalignment", "hexacopter")().rows(6)
    r, seen = Rotation.from_rotvec(turn), x.clone()  # states in axes that are turned against its own
    q = Rotation.from_quat(x[:, [7, 8, 9, 6]].numpy()) * r
    seen[:, 6:10] = torch.from_numpy(q.as_quat()[:, [3, 0, 1, 2]])
    seen[:, 10:13] = torch.from_numpy(r.inv().apply(x[:, 10:13].numpy()))
    there, here = own.drift(0.0, x, u).detach(), other.drift(0.0, seen, u).detach()
    turned = torch.from_numpy(r.inv().apply(there[:, 10:13].numpy()))
    torch.testing.assert_close(here[:, :6], there[:, :6], atol=1e-5, rtol=0)
    torch.testing.assert_close(here[:, 10:13], turned, atol=1e-5, rtol=0)


def test_thrust_follows_the_logged_voltage_and_other_columns_may_stand_before_it() -> None:
    values = {"thrust_gain": 5.0, "battery_voltage.sensitivity": 0.1}
    s = make_system("hexacopter", effects=["battery_voltage"], values=values)
    assert s.exogenous == ("battery_voltage",)
    u = torch.full((2, 7), 0.4)
    u[:, 6] = torch.tensor([16.0, 14.5])
    lift = s.drift(0.0, LEVEL.expand(2, 13), u)[:, 5].detach() + 9.81
    torch.testing.assert_close(lift, torch.tensor([12.0, 12.0 * 0.85]))
    s = make_system("hexacopter", effects=["input_delay", "battery_voltage", "motor_lag"])
    assert s.augment(LEVEL, torch.full((1, 7), 0.4)).shape == (1, 13 + 12 + 6)
