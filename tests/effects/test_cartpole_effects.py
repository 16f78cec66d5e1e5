"""Effects of the cart and pole: the contract, and what each does to the motion."""

from __future__ import annotations

import math

import pytest
import torch

from nsde_torch.systems import make_system
from tests.helpers.effect_contract import EffectContract
from tests.helpers.effect_rows import term


class TestCartCoulombFriction(EffectContract):
    name, system, size = "cart_coulomb_friction", "cartpole", 0.01

    def test_it_is_constant_in_motion(self) -> None:
        effect = self.make({"size": 0.3, "width": 0.01})
        x = torch.tensor([[0.0, 1.0, 0.0, 0.0], [0.0, -2.0, 0.0, 0.0]])
        torch.testing.assert_close(term(effect, x), torch.tensor([[-0.3], [0.3]]))


class TestCartViscousFriction(EffectContract):
    name, system = "cart_viscous_friction", "cartpole"

    def test_it_brakes_the_cart_in_proportion(self) -> None:
        x = torch.tensor([[0.0, 2.0, 0.0, 9.0]])
        torch.testing.assert_close(term(self.make({"damping": 0.4}), x), torch.tensor([[-0.8]]))


class TestPoleViscousFriction(EffectContract):
    name, system = "pole_viscous_friction", "cartpole"

    def test_it_brakes_the_pole_in_proportion(self) -> None:
        x = torch.tensor([[0.0, 9.0, 0.0, 2.0]])
        torch.testing.assert_close(term(self.make({"damping": 0.4}), x), torch.tensor([[-0.8]]))


class TestPoleCoulombFriction(EffectContract):
    name, system, size = "pole_coulomb_friction", "cartpole", 0.01

    def test_it_is_constant_in_motion(self) -> None:
        effect = self.make({"size": 0.3, "width": 0.01})
        x = torch.tensor([[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, -2.0]])
        torch.testing.assert_close(term(effect, x), torch.tensor([[-0.3], [0.3]]))


class TestTrackTilt(EffectContract):
    name, system = "track_tilt", "cartpole"

    @pytest.mark.parametrize("angle", [0.0, 0.7, math.pi])
    def test_gravity_along_the_track_moves_cart_and_pole_alike(self, angle: float) -> None:
        x, u = torch.tensor([[0.0, 0.3, angle, 0.5]]), torch.zeros(1, 1)
        level = make_system("cartpole").drift(0.0, x, u)
        tilted = self.machine(values={"track_tilt.slope": 0.02}).drift(0.0, x, u)
        torch.testing.assert_close((tilted - level).detach(), torch.tensor([[0.0, -9.8 * 0.02, 0.0, 0.0]]))

    def test_it_is_not_a_force_on_the_cart(self) -> None:
        x, u = torch.zeros(1, 4), torch.zeros(1, 1)
        pushed = make_system(
            "cartpole", effects=["constant_force"], values={"constant_force.acceleration": -0.2}
        )
        assert float(pushed.drift(0.0, x, u)[0, 3].detach()) > 0.1


class TestPositionBias(EffectContract):
    name, system = "position_bias[pole]", "cartpole"

    @pytest.mark.parametrize("angle", [0.0, 0.7, math.pi])
    def test_the_pole_moves_as_at_the_angle_that_it_has(self, angle: float) -> None:
        u = torch.full((1, 1), 3.0)
        true, read = (torch.tensor([[0.1, 0.3, a, 0.5]]) for a in (angle, angle + 0.05))
        sound = make_system("cartpole").drift(0.0, true, u)
        biased = make_system(
            "cartpole", effects=["angle_bias"], values={"angle_bias.bias": 0.05}
        )  # its older name
        torch.testing.assert_close(biased.drift(0.0, read, u).detach(), sound.detach())


class TestPoleGravity(EffectContract):
    name, system = "gravity", "cartpole"

    def test_it_is_what_another_gravity_does_to_the_pole(self) -> None:
        x, u = torch.tensor([[0.1, 0.3, 0.7, 0.5]]), torch.full((1, 1), 3.0)
        heavier = self.machine(values={"half_length": 0.25, "gravity.excess": 3.0 * 0.01 / (4.0 * 0.25)})
        sound = make_system("cartpole", values={"half_length": 0.25})
        # of gravity, force and squared speeds scaled alike, all accelerations are
        share = 9.81 / 9.8
        slower = x * torch.tensor([[1.0, 1.0, 1.0, share**-0.5]])
        expected = share * sound.drift(0.0, slower, u / share)[:, [1, 3]]
        torch.testing.assert_close(heavier.drift(0.0, x, u)[:, [1, 3]].detach(), expected.detach())
