"""Lags: the contract, and the response to a step by hand."""

from typing import ClassVar

import numpy as np
import pytest
import torch

from nsde_torch.errors import ConfigError
from nsde_torch.systems import make_system
from tests.helpers.effect_contract import EffectContract
from tests.helpers.effect_rows import flying
from tests.helpers.system_contract import solve


class TestMotorLag(EffectContract):
    name, system, memory = "motor_lag", "hexacopter", 6

    def test_a_step_of_the_command_is_followed_exponentially(self) -> None:
        tau, dt, n = 0.08, 0.005, 100
        s = self.machine(values={"motor_lag.time_constant": tau}).double()
        x0 = torch.zeros(1, 13, dtype=torch.float64)
        x0[0, 6] = 1.0
        before, after = 0.2, 0.6
        path, u = (
            [torch.cat((x0, torch.full((1, 6), before).double()), 1)],
            torch.full((1, 6), after).double(),
        )
        for _ in range(n):  # from memory that is not yet at rest
            path.append(_rk4(s, path[-1], u, dt))
        motors = torch.cat(path)[:, 13:].numpy()
        t = dt * np.arange(n + 1)
        expected = before + (after - before) * (1 - np.exp(-t / tau))
        np.testing.assert_allclose(motors, np.tile(expected[:, None], (1, 6)), atol=2e-6)

    def test_the_motors_not_the_commands_lift(self) -> None:
        s = self.machine(values={"thrust_gain": 5.0})
        x = flying([0.0, 0.0, 0.0])
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


class TestActuatorLag(EffectContract):
    name, system, memory = "actuator_lag", "cartpole", 1

    def test_it_follows_a_step_exponentially(self) -> None:
        effect = self.make({"time_constant": 0.5}).double()
        m = torch.tensor([[2.0]], dtype=torch.float64)
        rate = effect.memory_rate(0.0, torch.zeros(1, 4), torch.tensor([[5.0]]), m)
        torch.testing.assert_close(rate.detach(), torch.tensor([[6.0]], dtype=torch.float64))

    def test_multirotors_have_motor_lag_instead(self) -> None:
        with pytest.raises(ConfigError, match="motor_lag"):
            make_system("quadrotor", effects=["actuator_lag"])
        with pytest.raises(ConfigError, match="actuator_lag"):
            make_system("cartpole", effects=["motor_lag"])


class TestAsymmetricLag(EffectContract):
    name, system, memory = "asymmetric_lag", "quadrotor", 4
    values: ClassVar = {"rising": 0.03, "falling": 0.11}

    def test_a_step_up_is_followed_by_one_time_constant_and_one_down_by_the_other(self) -> None:
        s = self.machine(values={f"asymmetric_lag.{k}": v for k, v in self.values.items()}).double()
        for before, after, tau in ((0.3, 0.5, 0.03), (0.5, 0.3, 0.11)):
            z = torch.cat((flying([0.0, 0.0, 1.0])[:1].double(), torch.full((1, 4), before).double()), 1)
            for _ in range(20):
                z = _rk4(s, z, torch.full((1, 4), after, dtype=torch.float64), 0.005)
            expected = after + (before - after) * np.exp(-0.1 / tau)
            np.testing.assert_allclose(z[:, 13:].numpy(), expected, atol=1e-6)

    @torch.no_grad()
    def test_with_one_time_constant_it_is_the_lag_of_the_motors(self) -> None:
        x, u, memory = self.rows(50)
        both, one = (
            self.make({"rising": 0.06, "falling": 0.06}),
            make_system(self.system).make_effect("motor_lag"),
        )
        one.set_value("time_constant", 0.06)
        for effect in (both.double(), one.double()):
            effect.step = 0.01
        for name in ("forward", "memory_rate"):
            ours, theirs = (getattr(e, name)(0.0, x, u, memory) for e in (both, one))
            torch.testing.assert_close(ours, theirs)
        torch.testing.assert_close(both.held(u, 0.01), one.held(u, 0.01))


def _rk4(s: torch.nn.Module, z: torch.Tensor, u: torch.Tensor, dt: float) -> torch.Tensor:
    with torch.no_grad():
        a = s.drift(0.0, z, u)  # type: ignore[operator]
        b = s.drift(0.0, z + 0.5 * dt * a, u)  # type: ignore[operator]
        c = s.drift(0.0, z + 0.5 * dt * b, u)  # type: ignore[operator]
        d = s.drift(0.0, z + dt * c, u)  # type: ignore[operator]
        return z + dt / 6 * (a + 2 * b + 2 * c + d)
