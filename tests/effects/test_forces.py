"""Forces that do not depend on the state: the contract, and each formula by hand."""

from __future__ import annotations

import math

import torch

from tests.helpers.effect_contract import EffectContract
from tests.helpers.effect_rows import term


class TestConstantForce(EffectContract):
    name, system = "constant_force", "mass_spring_damper"

    def test_it_pushes_every_row_alike(self) -> None:
        effect = self.make({"acceleration": -0.7})
        torch.testing.assert_close(term(effect, torch.randn(3, 2)), torch.full((3, 1), -0.7))


class TestPeriodicForce(EffectContract):
    name, system = "periodic_force", "mass_spring_damper"
    values = {"sine": 0.3, "cosine": -0.2, "frequency": 1.7}

    def test_it_swings_with_the_clock(self) -> None:
        effect = self.make({"sine": 0.3, "cosine": 0.4, "frequency": 2.0})
        x = torch.zeros(1, 2)
        for t in (0.0, 0.125, 0.31):
            expected = 0.3 * math.sin(4 * math.pi * t) + 0.4 * math.cos(4 * math.pi * t)
            torch.testing.assert_close(term(effect, x, t=t), torch.tensor([[expected]]), atol=1e-5, rtol=0)

    def test_it_keeps_its_phase_on_a_clock_that_starts_far_away(self) -> None:
        effect = self.make({"sine": 1.0, "cosine": 0.0, "frequency": 0.25})
        late = torch.tensor([4.0e6 + 1.0], dtype=torch.float64)
        value = effect(late, torch.zeros(1, 2), torch.zeros(1, 1), torch.zeros(1, 0))
        torch.testing.assert_close(value.detach(), torch.ones(1, 1))
