"""The spring against its closed form."""

from typing import Any

import numpy as np
import pytest
import torch

from nsde_torch.systems import System, make_system
from tests.helpers.system_contract import SystemContract, solve


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
