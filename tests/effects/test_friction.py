"""Friction: the contract, and each formula by hand."""

from __future__ import annotations

import math

import torch

from tests.helpers.effect_contract import EffectContract
from tests.helpers.effect_rows import term


class TestViscousFriction(EffectContract):
    name, system = "viscous_friction", "cartpole"

    def test_it_brakes_in_proportion(self) -> None:
        effect = self.make({"damping": 0.5})
        x = torch.tensor([[9.0, -3.0, 0.0, 0.0]])
        torch.testing.assert_close(term(effect, x), torch.tensor([[1.5]]))


class TestCoulombFriction(EffectContract):
    name, system, size = "coulomb_friction", "mass_spring_damper", 0.01

    def test_it_is_constant_in_motion_and_gentle_at_rest(self) -> None:
        effect = self.make({"size": 0.3, "width": 0.01})
        x = torch.tensor([[0.0, 1.0], [0.0, -1.0], [0.0, 0.0], [0.0, 0.01]])
        expected = torch.tensor([[-0.3], [0.3], [0.0], [-0.3 * math.tanh(1.0)]])
        torch.testing.assert_close(term(effect, x), expected)


class TestAsymmetricFriction(EffectContract):
    name, system, size = "asymmetric_friction", "mass_spring_damper", 0.01

    def test_it_brakes_by_another_force_in_each_direction_and_rests_at_rest(self) -> None:
        effect = self.make({"size_forward": 0.3, "size_backward": 0.1, "width": 0.01})
        x = torch.tensor([[0.0, 1.0], [0.0, -1.0], [0.0, 0.0]])
        torch.testing.assert_close(term(effect, x), torch.tensor([[-0.3], [0.1], [0.0]]))

    def test_equal_sizes_are_coulomb_friction(self) -> None:
        both = self.make({"size_forward": 0.2, "size_backward": 0.2, "width": 0.05})
        plain = TestCoulombFriction().make({"size": 0.2, "width": 0.05})
        x = torch.randn(20, 2) * 0.1
        torch.testing.assert_close(term(both, x), term(plain, x))


class TestStribeckFriction(EffectContract):
    name, system, size = "stribeck_friction", "mass_spring_damper", 0.1

    def test_it_falls_from_rest_to_speed(self) -> None:
        effect = self.make({"size": 0.2, "extra": 0.1, "speed": 0.5, "width": 0.001})
        x = torch.tensor([[0.0, 0.01], [0.0, 0.5], [0.0, -5.0]])
        expected = [-0.2 - 0.1 * math.exp(-0.0004), -0.2 - 0.1 * math.exp(-1.0), 0.2]
        torch.testing.assert_close(term(effect, x)[:, 0], torch.tensor(expected))


class TestQuadraticDamping(EffectContract):
    name, system = "quadratic_damping", "cartpole"

    def test_it_grows_with_the_square_against_the_motion(self) -> None:
        effect = self.make({"damping": 0.5})
        x = torch.tensor([[0.0, 2.0, 0.0, 0.0], [0.0, -4.0, 0.0, 0.0]])
        torch.testing.assert_close(term(effect, x), torch.tensor([[-2.0], [8.0]]))
