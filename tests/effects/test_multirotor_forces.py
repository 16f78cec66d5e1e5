"""Forces on multirotors beside drag: the contract, and each formula by hand."""

from __future__ import annotations

import torch
from scipy.spatial.transform import Rotation

from tests.helpers.effect_contract import EffectContract
from tests.helpers.effect_rows import flying, term


class TestConstantWorldForce(EffectContract):
    name, system = "constant_world_force", "hexacopter"

    def test_it_pushes_alike_at_every_attitude(self) -> None:
        x, u, _ = self.rows(5)
        pushed = self.machine(values={"constant_world_force.acceleration": [0.1, -0.2, 0.3]}).double()
        change = pushed.drift(0.0, x, u) - self.machine().double().drift(0.0, x, u)
        expected = torch.tensor([0.1, -0.2, 0.3]).double().expand(5, 3)
        torch.testing.assert_close(change[:, 3:6].detach(), expected, atol=1e-6, rtol=0)


class TestGroundEffect(EffectContract):
    name, system = "ground_effect", "hexacopter"

    def test_at_half_a_metre_a_rotor_lifts_as_cheeseman_and_bennett_say(self) -> None:
        radius, z = 0.4, 0.5
        effect = self.make({"area": (radius / 4) ** 2, "height": 1e-4})
        x = flying([0.0, 0.0, 0.0])
        x[0, 2] = z
        thrust = torch.tensor([[10.0]])
        u = torch.cat((torch.zeros(1, 6), thrust), 1)
        exact = 10.0 * (1 / (1 - (radius / (4 * z)) ** 2) - 1)
        assert abs(float(term(effect, x, u)[0, 2]) / exact - 1) < 0.05

    def test_it_reads_the_thrust_of_the_motors_and_acts_along_the_body(self) -> None:
        s = self.machine(values={"thrust_gain": 5.0, "ground_effect.area": 0.02, "ground_effect.height": 0.2})
        x, u = flying([0.0, 0.0, 0.0], Rotation.from_euler("y", 90, degrees=True)), torch.full((1, 6), 0.4)
        x[0, 2] = 0.4
        acceleration = s.drift(0.0, x, u)[0, 3:6].detach()
        expected = torch.tensor([12.0 * (1 + 0.02 / (0.16 + 0.04)), 0.0, -9.81])
        torch.testing.assert_close(acceleration, expected, atol=1e-4, rtol=0)


class TestThrustMisalignment(EffectContract):
    name, system = "thrust_misalignment", "quadrotor"

    def test_a_share_of_the_thrust_points_sideways(self) -> None:
        s = self.machine(values={"thrust_gain": 5.0, "thrust_misalignment.tilt": [0.01, -0.02]})
        acceleration = s.drift(0.0, flying([0.0, 0.0, 0.0]), torch.full((1, 4), 0.5))[0, 3:6].detach()
        torch.testing.assert_close(acceleration, torch.tensor([0.1, -0.2, 10.0 - 9.81]), atol=1e-5, rtol=0)
