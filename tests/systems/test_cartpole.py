"""The cartpole against Lagrange's equations, solved as a linear system in NumPy.

M x'' + m l cos(theta) theta'' = F + m l theta'^2 sin(theta)
m l cos(theta) x'' + 4/3 m l^2 theta'' = m g l sin(theta)
"""

from math import pi
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.effects import Port
from nsde_torch.systems import System, make_system
from tests.helpers.system_contract import SystemContract, solve

Array = NDArray[np.float64]
TOTAL, POLE, LENGTH, G = 1.7, 0.3, 0.8, 9.8
VALUES = {"force_gain": 1 / TOTAL, "pole_share": POLE / TOTAL, "half_length": LENGTH}


def accelerations(x: Array, force: float, torque: float = 0.0) -> Array:
    """(x'', theta'') by Lagrange; `torque` acts on the pole [N m]."""
    _, _, theta, rate = x
    arm = POLE * LENGTH
    mass = np.array([[TOTAL, arm * np.cos(theta)], [arm * np.cos(theta), 4 / 3 * arm * LENGTH]])
    right = np.array([force + arm * rate**2 * np.sin(theta), arm * G * np.sin(theta) + torque])
    return np.linalg.solve(mass, right)


def energy(x: Array) -> Array:
    _, v, theta, rate = x.T
    kinetic = 0.5 * TOTAL * v**2 + POLE * LENGTH * np.cos(theta) * v * rate
    return kinetic + 2 / 3 * POLE * LENGTH**2 * rate**2 + POLE * G * LENGTH * np.cos(theta)


class TestCartpole(SystemContract):
    def make(self, **options: Any) -> System:
        return make_system("cartpole", **options)

    def twin(self, x: Tensor) -> Tensor:
        return x + torch.tensor([0.0, 0.0, 2 * pi, 0.0], dtype=x.dtype)

    def test_motion_is_lagranges(self) -> None:
        s = self.make(values=VALUES).double()
        x, u = 2 * self.states(50), 5 * (self.inputs(50) - 0.5)
        rate = s.drift(0.0, x, u).detach().numpy()
        for k in range(50):
            expected = accelerations(x[k].numpy(), float(u[k, 0]))
            np.testing.assert_allclose(rate[k, [1, 3]], expected, rtol=1e-6, atol=1e-6)

    def test_a_torque_on_the_pole_also_moves_the_cart(self) -> None:
        s = self.make(values=VALUES).double()
        x, torque = np.array([0.0, 0.1, 0.4, 0.2]), 0.7
        shift = accelerations(x, 0.0, torque) - accelerations(x, 0.0)
        port = {Port.TORQUE: torch.tensor([[torque / (4 / 3 * POLE * LENGTH**2)]]).double()}
        state, none = torch.from_numpy(x)[None], torch.zeros(1, 1).double()
        found = s.drift(0.0, state, none, port) - s.drift(0.0, state, none)
        np.testing.assert_allclose(found.detach().numpy()[0, [1, 3]], shift, rtol=1e-6)

    def test_energy_is_conserved_through_full_turns(self) -> None:
        s = self.make(values=VALUES).double()
        start = torch.tensor([[0.0, 0.3, 0.2, 1.0]], dtype=torch.float64)
        path = solve(s, start, torch.zeros(1, 4000, 1).double(), 0.0025)[0].numpy()
        assert np.ptp(path[:, 2]) > 2 * pi
        np.testing.assert_allclose(energy(path), energy(path)[0], rtol=1e-5)

    @pytest.mark.parametrize("turns", [-3, 1, 5])
    def test_the_error_of_the_angle_goes_the_short_way(self, turns: int) -> None:
        s = self.make().double()
        a = torch.tensor([[0.0, 0.0, 3.0 + 2 * pi * turns, 0.0]], dtype=torch.float64)
        b = torch.tensor([[0.0, 0.0, -3.0, 0.0]], dtype=torch.float64)
        assert float(s.error(a, b)[0, 2]) == pytest.approx(6.0 - 2 * pi)
