"""Moments on multirotors: the contract, and each formula by hand."""

from __future__ import annotations

import numpy as np
import torch

from tests.helpers.effect_contract import EffectContract
from tests.helpers.effect_rows import flying, term


class TestAngularDamping(EffectContract):
    name, system = "angular_damping", "hexacopter"

    def test_it_slows_each_rate(self) -> None:
        effect = self.make({"damping": [0.1, 0.2, 0.3]})
        x = flying([0.0, 0.0, 0.0], rates=(1.0, -2.0, 3.0))
        torch.testing.assert_close(term(effect, x), torch.tensor([[-0.1, 0.4, -0.9]]))


class TestComOffset(EffectContract):
    name, system = "com_offset", "hexacopter"

    def test_a_centre_of_mass_ahead_lets_the_nose_sink(self) -> None:
        c, mass, inertia, thrust = np.array([0.02, 0.01, 0.0]), 2.0, 0.05, 10.0
        moment = np.cross(-c, [0.0, 0.0, mass * thrust]) / inertia
        effect = self.make({"offset": [float(v) for v in c[:2] * mass / inertia]})
        u = torch.cat((torch.zeros(1, 6), torch.tensor([[thrust]])), 1)
        found = term(effect, flying([0.0, 0.0, 0.0]), u)[0]
        torch.testing.assert_close(found, torch.from_numpy(moment).float())
        assert (
            float(found[1]) > 0
        )  # FLU: pitch up is negative, the nose goes down here... by the rear that lifts


class TestGyroscopicMoment(EffectContract):
    name, system = "gyroscopic_moment", "quadrotor"

    def test_it_is_the_rate_of_change_of_the_angular_momentum_of_the_rotors(self) -> None:
        # a rotor that spins with +z turns the body by -z: the yaw sign of its motor is -1
        commands, rates, full = np.array([0.2, 0.3, 0.6, 0.7]), np.array([0.5, -1.0, 2.0]), 2.0
        yaw = np.array([-1.0, -1.0, 1.0, 1.0])
        momentum = np.array([0.0, 0.0, -(yaw * commands).sum() * full])
        expected = -np.cross(rates, momentum)
        s = self.machine(values={"gyroscopic_moment.momentum": full})
        x = flying([0.0, 0.0, 0.0], rates=(0.5, -1.0, 2.0))
        u = torch.from_numpy(commands).float()[None]
        change = s.drift(0.0, x, u) - type(s)().drift(0.0, x, u)
        torch.testing.assert_close(
            change[0, 10:].detach(), torch.from_numpy(expected).float(), atol=1e-5, rtol=0
        )


class TestFlappingMoment(EffectContract):
    name, system = "flapping_moment", "hexacopter"

    def test_forward_flight_lifts_the_nose_and_flight_to_the_left_the_left_side(self) -> None:
        effect = self.make({"gain": [0.2, 0.3]})
        x = flying([2.0, 1.0, 5.0])
        torch.testing.assert_close(term(effect, x), torch.tensor([[0.2, -0.6, 0.0]]))


class TestInertiaCoupling(EffectContract):
    name, system = "inertia_coupling", "hexacopter"

    def test_it_is_eulers_equation_with_the_full_matrix_to_first_order(self) -> None:
        small = np.array([2e-3, -1e-3, 1.5e-3])  # J_xy, J_xz, J_yz over J_zz
        x, u, _ = self.rows(5)
        u = u[:, :6]
        s = self.machine(values={"inertia_coupling.product": [float(v) for v in small]}).double()
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
