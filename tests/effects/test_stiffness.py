"""Springs: the contract, and each formula by hand."""

from __future__ import annotations

import torch

from tests.helpers.effect_contract import EffectContract
from tests.helpers.effect_rows import term


class TestLinearSpring(EffectContract):
    name, system = "linear_spring", "mass_spring_damper"

    def test_it_pulls_back_in_proportion(self) -> None:
        effect = self.make({"stiffness": 4.0})
        torch.testing.assert_close(term(effect, torch.tensor([[0.5, 9.0]])), torch.tensor([[-2.0]]))


class TestCubicStiffness(EffectContract):
    name, system = "cubic_stiffness", "mass_spring_damper"

    def test_it_pulls_with_the_cube_of_the_extension(self) -> None:
        effect = self.make({"stiffness": 3.0})
        torch.testing.assert_close(term(effect, torch.tensor([[-2.0, 9.0]])), torch.tensor([[24.0]]))
