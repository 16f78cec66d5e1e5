"""Machines against closed forms, Lagrange's equations and an independent rigid body in NumPy."""

from math import pi
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from nsde_torch.effects import Port
from nsde_torch.systems import System, make_system
from tests.helpers.effect_rows import flying
from tests.helpers.system_contract import SystemContract, solve

Array = NDArray[np.float64]
LEVEL = flying([0.0, 0.0, 0.0])

# Motors as PX4 numbers them: place (forward, left) with the arm as unit, and the sense of the propeller seen
# from above. A propeller that turns clockwise pushes the body the other way round, about +z.
S, H = np.sqrt(3) / 2, 0.5
GEOMETRY: dict[str, list[tuple[float, float, str]]] = {
    "hexacopter": [
        *((0, -1, "cw"), (0, 1, "ccw"), (S, H, "cw"), (-S, -H, "ccw"), (S, -H, "ccw"), (-S, H, "cw"))
    ],
    "quadrotor": [(1, -1, "ccw"), (-1, 1, "ccw"), (1, 1, "cw"), (-1, -1, "cw")],
}
GAINS = {"thrust_gain": 5.1, "roll_gain": 60.0, "pitch_gain": 45.0, "yaw_gain": 6.0}
VALUES = {**GAINS, "thrust_offset": -0.4, "inertia_x": 0.6, "inertia_y": 0.9}


def rigid_body(x: Array, u: Array, name: str) -> Array:
    """Rates of one state by Newton and Euler, with an inertia matrix and moments in its own units."""
    q, omega = x[6:10], x[10:13]
    turn = Rotation.from_quat(np.roll(q, -1))
    j_z = 0.02  # any value: only ratios can be seen
    inertia = np.diag([VALUES["inertia_x"], VALUES["inertia_y"], 1.0]) * j_z
    gains = np.diag(inertia) * [VALUES["roll_gain"], VALUES["pitch_gain"], VALUES["yaw_gain"]]
    moment = np.zeros(3)
    for (forward, left, sense), command in zip(GEOMETRY[name], u, strict=True):
        arm = np.cross([forward, left, 0.0], [0.0, 0.0, 1.0])
        drag = np.array([0.0, 0.0, 1.0 if sense == "cw" else -1.0])
        moment += gains * (arm + drag) * command
    thrust = np.array([0.0, 0.0, VALUES["thrust_gain"] * u.sum() + VALUES["thrust_offset"]])
    acceleration = turn.apply(thrust) + np.array([0.0, 0.0, -9.81])
    product = Rotation.from_quat(np.roll(q, -1)).as_matrix() @ omega  # world rates
    w, r = q[0], q[1:]
    q_rate = 0.5 * np.concatenate([[-product @ r], w * product + np.cross(product, r)])
    angular = np.linalg.solve(inertia, moment - np.cross(omega, inertia @ omega))
    return np.concatenate([x[3:6], acceleration, q_rate, angular])


class MultirotorContract(SystemContract):
    name: str

    def make(self, **options: Any) -> System:
        return make_system(self.name, **options)

    def twin(self, x: Tensor) -> Tensor:
        return torch.cat((x[:, :6], -x[:, 6:10], x[:, 10:]), 1)

    def other_values(self) -> dict[str, float]:
        return VALUES

    def excitation(self, n: int, dt: float) -> Tensor:
        nu = self.make().nu
        t = dt * torch.arange(n, dtype=torch.float64)
        hover = (9.81 - VALUES["thrust_offset"]) / VALUES["thrust_gain"] / nu
        return torch.stack([hover + 0.02 * torch.sin((7 + 2 * k) * t + k) for k in range(nu)], 1)

    def test_every_rate_is_that_of_an_independent_rigid_body(self) -> None:
        s = self.make(values=VALUES).double()
        x, u = self.states(40), self.inputs(40)
        rate = s.drift(0.0, x, u).detach().numpy()
        for k in range(40):
            expected = rigid_body(x[k].numpy(), u[k].numpy(), self.name)
            np.testing.assert_allclose(rate[k, :6], expected[:6], rtol=1e-6, atol=1e-6)
            np.testing.assert_allclose(rate[k, 6:10], expected[6:10], rtol=0, atol=1e-13)
            # the mixing is written with three decimals
            np.testing.assert_allclose(rate[k, 10:], expected[10:], rtol=1e-4, atol=3e-3)

    def test_propellers_that_turn_the_other_way_yaw_the_other_way(self) -> None:
        x, u = self.states(8), self.inputs(8)
        x[:, 10:13] = 0.0
        one, other = (self.make(yaw_direction=way).double().drift(0.0, x, u) for way in (1, -1))
        torch.testing.assert_close(other[:, 12], -one[:, 12])
        torch.testing.assert_close(other[:, :12], one[:, :12])

    def test_first_values_find_the_gains(self) -> None:
        x, u, dt = self.simulated()
        found = self.make().start_values(x.numpy(), u.numpy(), dt)
        assert {name: found[name][0] for name in GAINS} == pytest.approx(GAINS, rel=0.05)

    def test_the_thrust_map_of_degree_two_and_three(self) -> None:
        x = LEVEL
        u = torch.full((1, self.make().nu), 0.5)
        for degree, curve, shape in ((2, [0.4], 0.5 + 0.4 * 0.25), (3, [0.4, -0.2], 0.6 - 0.2 * 0.125)):
            s = self.make(thrust_degree=degree, values={"thrust_gain": 5.0, "thrust_curve": curve})
            lift = float(s.drift(0.0, x, u)[0, 5].detach()) + 9.81
            assert lift == pytest.approx(5.0 * shape * s.nu, rel=1e-5)

    def test_a_curved_thrust_map_starts_as_the_straight_one(self) -> None:
        x, u = self.states(5), self.inputs(5)
        straight, curved = self.make().double(), self.make(thrust_degree=3).double()
        torch.testing.assert_close(straight.drift(0.0, x, u), curved.drift(0.0, x, u))
        assert curved.declared_parameters()["thrust_curve"][0].shape == (2,)
        assert "thrust_curve" not in self.make().declared_parameters()

    def test_features_do_not_change_with_heading_or_place(self) -> None:
        s = self.make().double()
        x = self.states(6)
        yaw = Rotation.from_euler("z", 1.1)
        turned = x.numpy().copy()
        turned[:, :3] += 7.0
        turned[:, 3:6] = yaw.apply(turned[:, 3:6])
        attitude = yaw * Rotation.from_quat(np.roll(turned[:, 6:10], -1, axis=1))
        turned[:, 6:10] = np.roll(attitude.as_quat(), 1, axis=1)
        torch.testing.assert_close(s.features(torch.from_numpy(turned)), s.features(x))
        torch.testing.assert_close(s.residual_features(torch.from_numpy(turned)), s.residual_features(x))


class TestHexacopter(MultirotorContract):
    name = "hexacopter"


class TestQuadrotor(MultirotorContract):
    name = "quadrotor"


TOTAL, POLE, LENGTH, G = 1.7, 0.3, 0.8, 9.8
CART = {"force_gain": 1 / TOTAL, "pole_share": POLE / TOTAL, "half_length": LENGTH}


def accelerations(x: Array, force: float, torque: float = 0.0) -> Array:
    """(x'', theta'') by Lagrange; `torque` acts on the pole [N m]."""
    _, _, theta, rate = x
    arm = POLE * LENGTH
    mass = np.array([[TOTAL, arm * np.cos(theta)], [arm * np.cos(theta), 4 / 3 * arm * LENGTH]])
    right = np.array([force + arm * rate**2 * np.sin(theta), arm * G * np.sin(theta) + torque])
    return np.linalg.solve(mass, right)


class TestCartpole(SystemContract):
    def make(self, **options: Any) -> System:
        return make_system("cartpole", **options)

    def twin(self, x: Tensor) -> Tensor:
        return x + torch.tensor([0.0, 0.0, 2 * pi, 0.0], dtype=x.dtype)

    def test_motion_is_lagranges(self) -> None:
        s = self.make(values=CART).double()
        x, u = 2 * self.states(50), 5 * (self.inputs(50) - 0.5)
        rate = s.drift(0.0, x, u).detach().numpy()
        for k in range(50):
            expected = accelerations(x[k].numpy(), float(u[k, 0]))
            np.testing.assert_allclose(rate[k, [1, 3]], expected, rtol=1e-6, atol=1e-6)

    def test_a_torque_on_the_pole_also_moves_the_cart(self) -> None:
        s = self.make(values=CART).double()
        x, torque = np.array([0.0, 0.1, 0.4, 0.2]), 0.7
        shift = accelerations(x, 0.0, torque) - accelerations(x, 0.0)
        port = {Port.TORQUE: torch.tensor([[torque / (4 / 3 * POLE * LENGTH**2)]]).double()}
        state, none = torch.from_numpy(x)[None], torch.zeros(1, 1).double()
        found = s.drift(0.0, state, none, port) - s.drift(0.0, state, none)
        np.testing.assert_allclose(found.detach().numpy()[0, [1, 3]], shift, rtol=1e-6)

    @pytest.mark.parametrize("turns", [-3, 1, 5])
    def test_the_error_of_the_angle_goes_the_short_way(self, turns: int) -> None:
        s = self.make().double()
        a = torch.tensor([[0.0, 0.0, 3.0 + 2 * pi * turns, 0.0]], dtype=torch.float64)
        b = torch.tensor([[0.0, 0.0, -3.0, 0.0]], dtype=torch.float64)
        assert float(s.error(a, b)[0, 2]) == pytest.approx(6.0 - 2 * pi)


class TestMassSpringDamper(SystemContract):
    def make(self, **options: Any) -> System:
        return make_system("mass_spring_damper", **options)

    @pytest.mark.parametrize("stiffness", [1.0, 4.0])
    def test_a_damped_spring_follows_its_closed_form(self, stiffness: float) -> None:
        values = {"linear_spring.stiffness": stiffness, "viscous_friction.damping": 0.5}
        s = self.make(values=values).double()
        n, dt = 500, 0.01
        path = solve(s, torch.tensor([[0.1, 0.0]]).double(), torch.zeros(1, n, 1).double(), dt)[0].numpy()
        t, w = dt * np.arange(n + 1), np.sqrt(stiffness - 0.0625)
        expected = 0.1 * np.exp(-0.25 * t) * (np.cos(w * t) + 0.25 / w * np.sin(w * t))
        np.testing.assert_allclose(path[:, 0], expected, atol=1e-7)

    @pytest.mark.parametrize("gain", [0.5, 1.0, 2.0])
    def test_without_declared_physics_only_the_force_acts_and_it_is_divided_by_the_mass(
        self, gain: float
    ) -> None:
        s = self.make(declared=[], values={"force_gain": gain})
        assert s.effect_names == ()
        rate = s.drift(0.0, torch.tensor([[5.0, 2.0]]), torch.tensor([[3.0]]))
        torch.testing.assert_close(rate, torch.tensor([[2.0, 3.0 * gain]]))
