"""Every effect of the catalogue: the contract, and its formula by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from nsde_torch.effects import EFFECTS, Effect
from nsde_torch.systems import make_system
from tests.helpers.effect_contract import EffectContract
from tests.helpers.system_contract import solve

NO_MEMORY = torch.zeros(1, 0)


def term(effect: Effect, x: torch.Tensor, u: torch.Tensor | None = None) -> torch.Tensor:
    return effect(0.0, x, torch.zeros(len(x), 6) if u is None else u, NO_MEMORY.expand(len(x), 0)).detach()


class TestLinearSpring(EffectContract):
    name, system = "linear_spring", "mass_spring_damper"

    def test_it_pulls_back_in_proportion(self) -> None:
        effect = self.make({"stiffness": 4.0})
        torch.testing.assert_close(term(effect, torch.tensor([[0.5, 9.0]])), torch.tensor([[-2.0]]))


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


class TestConstantForce(EffectContract):
    name, system = "constant_force", "mass_spring_damper"

    def test_it_pushes_every_row_alike(self) -> None:
        effect = self.make({"acceleration": -0.7})
        torch.testing.assert_close(term(effect, torch.randn(3, 2)), torch.full((3, 1), -0.7))


def flying(velocity: list[float], attitude: Rotation) -> torch.Tensor:
    x = torch.zeros(1, 13)
    x[0, 3:6] = torch.tensor(velocity)
    x[0, 6:10] = torch.from_numpy(np.roll(attitude.as_quat(), 1)).float()
    return x


class TestLinearDrag(EffectContract):
    name, system = "linear_drag", "hexacopter"

    def test_it_brakes_along_the_axes_of_the_body(self) -> None:
        effect = self.make({"drag": [0.1, 0.2, 0.3]})
        # turned left by a quarter: world's +x is the body's right (-y)
        x = flying([2.0, 0.0, 1.0], Rotation.from_euler("z", 90, degrees=True))
        torch.testing.assert_close(term(effect, x), torch.tensor([[0.0, 0.4, -0.3]]), atol=1e-6, rtol=0)

    def test_it_takes_energy_at_every_attitude(self) -> None:
        s = self.machine().double()
        x, _, _ = self.rows(50)
        u = torch.zeros(50, s.nu).double()
        force = s.drift(0.0, x, u)[:, 3:6] - torch.tensor([0.0, 0.0, -9.81]).double()
        assert bool(((force * x[:, 3:6]).sum(1) < 0).all())


class TestQuadraticDrag(EffectContract):
    name, system = "quadratic_drag", "quadrotor"

    def test_it_grows_with_the_square_of_the_speed(self) -> None:
        effect = self.make({"drag": [0.1, 0.1, 0.2]})
        x = flying([3.0, 0.0, 4.0], Rotation.identity())
        torch.testing.assert_close(term(effect, x), torch.tensor([[-1.5, 0.0, -4.0]]))
        doubled = flying([6.0, 0.0, 8.0], Rotation.identity())
        torch.testing.assert_close(term(effect, doubled), 4 * term(effect, x))


class TestAngularDamping(EffectContract):
    name, system = "angular_damping", "hexacopter"

    def test_it_slows_each_rate(self) -> None:
        effect = self.make({"damping": [0.1, 0.2, 0.3]})
        x = flying([0.0, 0.0, 0.0], Rotation.identity())
        x[0, 10:] = torch.tensor([1.0, -2.0, 3.0])
        torch.testing.assert_close(term(effect, x), torch.tensor([[-0.1, 0.4, -0.9]]))


class TestMotorLag(EffectContract):
    name, system, memory = "motor_lag", "hexacopter", 6

    def test_a_step_of_the_command_is_followed_exponentially(self) -> None:
        tau, dt, n = 0.08, 0.005, 100
        s = self.machine(values={"motor_lag.time_constant": tau}).double()
        x0 = torch.zeros(1, 13, dtype=torch.float64)
        x0[0, 6] = 1.0
        before, after = 0.2, 0.6
        start = torch.cat((x0, torch.full((1, 6), before).double()), 1)
        u = torch.full((1, n, 6), after, dtype=torch.float64)
        z = start
        path = [z]
        for _ in range(n):  # from memory that is not yet at rest
            z = _rk4(s, z, u[:, 0], dt)
            path.append(z)
        motors = torch.cat(path)[:, 13:].numpy()
        t = dt * np.arange(n + 1)
        expected = before + (after - before) * (1 - np.exp(-t / tau))
        np.testing.assert_allclose(motors, np.tile(expected[:, None], (1, 6)), atol=2e-6)

    def test_the_motors_not_the_commands_lift(self) -> None:
        s = self.machine(values={"thrust_gain": 5.0})
        x = flying([0.0, 0.0, 0.0], Rotation.identity())
        z = torch.cat((x, torch.full((1, 6), 0.1)), 1)
        lift = float(s.drift(0.0, z, torch.ones(1, 6))[0, 5].detach()) + 9.81
        assert lift == pytest.approx(5.0 * 0.6, rel=1e-5)

    def test_a_constant_command_flies_as_without_lag(self) -> None:
        x, u, _ = self.rows(3)
        u = u[:, None].expand(3, 50, 6)
        lagging = solve(self.machine().double(), x, u, 0.01)[..., :13]
        plain = solve(make_system("hexacopter").double(), x, u, 0.01)
        torch.testing.assert_close(lagging, plain)

    def test_a_quadrotor_has_four_of_it(self) -> None:
        s = make_system("quadrotor", effects=["motor_lag"])
        assert s.nz == 13 + 4


def _rk4(s: torch.nn.Module, z: torch.Tensor, u: torch.Tensor, dt: float) -> torch.Tensor:
    with torch.no_grad():
        a = s.drift(0.0, z, u)  # type: ignore[operator]
        b = s.drift(0.0, z + 0.5 * dt * a, u)  # type: ignore[operator]
        c = s.drift(0.0, z + 0.5 * dt * b, u)  # type: ignore[operator]
        d = s.drift(0.0, z + dt * c, u)  # type: ignore[operator]
        return z + dt / 6 * (a + 2 * b + 2 * c + d)


def test_every_effect_of_the_catalogue_has_its_contract() -> None:
    tested = {cls.name for cls in EffectContract.__subclasses__()}
    assert tested == set(EFFECTS)
    assert all(key == cls.name for key, cls in EFFECTS.items())
