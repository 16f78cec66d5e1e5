"""What becomes of a motor's command: the contract, and each formula by hand."""

from __future__ import annotations

import torch

from nsde_torch.systems import make_system
from tests.helpers.effect_contract import EffectContract
from tests.helpers.effect_rows import flying, term

X = flying([0.0, 0.0, 0.0])


class TestMotorEfficiencyLoss(EffectContract):
    name, system = "motor_efficiency_loss", "quadrotor"

    def test_it_has_one_loss_for_each_motor(self) -> None:
        effect = self.make({"loss": [0.1, 0.2, 0.3, 0.4]})
        torch.testing.assert_close(
            term(effect, X, torch.full((1, 4), 0.5)), torch.tensor([[-0.05, -0.1, -0.15, -0.2]])
        )
        assert len(make_system("hexacopter", effects=[self.name]).all_declared()[self.name + ".loss"][0]) == 6

    def test_a_weak_motor_lifts_less_and_turns_the_machine(self) -> None:
        losses = [0.2, 1e-6, 1e-6, 1e-6]  # front right
        s = self.machine(values={"thrust_gain": 5.0, "roll_gain": 50.0, "motor_efficiency_loss.loss": losses})
        rate = s.drift(0.0, X, torch.full((1, 4), 0.5))[0].detach()
        torch.testing.assert_close(rate[5], torch.tensor(5.0 * 1.9 - 9.81), atol=1e-4, rtol=0)
        torch.testing.assert_close(rate[10], torch.tensor(50.0 * 0.1), atol=1e-3, rtol=0)  # to the right


class TestThrustSag(EffectContract):
    name, system = "thrust_sag", "hexacopter"

    def test_thrust_falls_in_proportion_to_time(self) -> None:
        u = torch.full((1, 6), 0.5)
        torch.testing.assert_close(u + term(self.make({"rate": 0.002}), X, u, t=50.0), 0.9 * u)


class TestSupplySag(EffectContract):
    name, system = "supply_sag", "hexacopter"

    def test_each_motor_loses_by_what_all_of_them_draw(self) -> None:
        u = torch.tensor([[0.2, 0.8, 0.5, 0.5, 0.5, 0.5]])
        torch.testing.assert_close(u + term(self.make({"drop": 0.2}), X, u), 0.9 * u)


class TestBatteryVoltage(EffectContract):
    name, system = "battery_voltage", "hexacopter"

    def test_thrust_follows_the_logged_voltage(self) -> None:
        s = self.machine(values={"thrust_gain": 5.0, "battery_voltage.sensitivity": 0.1})
        assert s.exogenous == ("battery_voltage",)
        u = torch.full((2, 7), 0.4)
        u[:, 6] = torch.tensor([16.0, 14.5])
        lift = s.drift(0.0, X.expand(2, 13), u)[:, 5].detach() + 9.81
        torch.testing.assert_close(lift, torch.tensor([12.0, 12.0 * 0.85]))

    def test_other_logged_columns_may_stand_before_it(self) -> None:
        s = make_system("hexacopter", effects=["input_delay", "battery_voltage", "motor_lag"])
        z = s.augment(X, torch.cat((torch.full((1, 6), 0.4), torch.tensor([[16.0]])), 1))
        assert z.shape == (1, 13 + 12 + 6)


class TestThrustCurve(EffectContract):
    name, system = "thrust_curve", "hexacopter"

    def test_the_square_of_the_command_is_added(self) -> None:
        u = torch.tensor([[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]])
        torch.testing.assert_close(term(self.make({"curvature": 2.0}), X, u), 2.0 * u**2)
