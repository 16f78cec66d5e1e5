"""What an actuator makes of its command: the contract, and each formula by hand."""

from __future__ import annotations

import torch

from nsde_torch.diagnosis.candidates import why_not
from nsde_torch.effects import EFFECTS
from nsde_torch.systems import make_system
from tests.helpers.effect_contract import EffectContract
from tests.helpers.effect_rows import term

X = torch.zeros(4, 4)
U = torch.tensor([[0.05], [-0.3], [2.0], [-2.0]])


class TestActuatorDeadband(EffectContract):
    name, system = "actuator_deadband", "cartpole"

    def test_small_commands_do_nothing_and_large_ones_lose_as_much(self) -> None:
        effect = self.make({"width": 0.2})
        torch.testing.assert_close(U + term(effect, X, U), torch.tensor([[0.0], [-0.1], [1.8], [-1.8]]))


class TestActuatorSaturation(EffectContract):
    name, system = "actuator_saturation", "cartpole"

    def test_commands_are_cut_to_the_level(self) -> None:
        effect = self.make({"level": 1.5})
        torch.testing.assert_close(U + term(effect, X, U), torch.tensor([[0.05], [-0.3], [1.5], [-1.5]]))

    def test_a_command_is_cut_before_the_lag(self) -> None:
        s = make_system("cartpole", effects=["actuator_lag", "actuator_saturation"])
        z = s.augment(torch.zeros(1, 4), torch.tensor([[3.0]]))
        torch.testing.assert_close(z[:, 4:], torch.tensor([[0.5]]))


class TestAsymmetricDeadband(EffectContract):
    name, system, signed = "asymmetric_deadband", "cartpole", True

    def test_each_sign_has_a_width_of_its_own(self) -> None:
        effect = self.make({"width_forward": 0.2, "width_backward": 0.5})
        torch.testing.assert_close(U + term(effect, X, U), torch.tensor([[0.0], [0.0], [1.8], [-1.5]]))


class TestAsymmetricGain(EffectContract):
    name, system = "asymmetric_gain", "cartpole"

    def test_positive_commands_act_more_strongly(self) -> None:
        effect = self.make({"asymmetry": 0.1})
        torch.testing.assert_close(U + term(effect, X, U), torch.where(U > 0, 1.1, 0.9) * U)


class TestAsymmetricSaturation(EffectContract):
    name, system, signed = "asymmetric_saturation", "cartpole", True

    def test_each_sign_has_a_level_of_its_own(self) -> None:
        effect = self.make({"level_forward": 1.5, "level_backward": 0.2})
        torch.testing.assert_close(U + term(effect, X, U), torch.tensor([[0.05], [-0.2], [1.5], [-0.2]]))


class TestActuatorEfficiencyLoss(EffectContract):
    name, system = "actuator_efficiency_loss", "cartpole"

    def test_each_input_has_a_loss_of_its_own(self) -> None:
        effect = EFFECTS[self.name]({"loss": [0.1, 0.4]}, n_inputs=2)
        u = torch.tensor([[2.0, -1.0]])
        torch.testing.assert_close(u + term(effect, X[:1], u), torch.tensor([[1.8, -0.6]]))

    def test_it_is_no_candidate_where_nothing_can_be_compared(self) -> None:
        assert why_not(make_system("cartpole"), self.name) == "it compares inputs, and the machine has one"


class TestActuatorGainDrift(EffectContract):
    name, system = "actuator_gain_drift", "mass_spring_damper"

    def test_strength_changes_in_proportion_to_time(self) -> None:
        effect = self.make({"rate": -0.01})
        torch.testing.assert_close(U + term(effect, X[:, :2], U, t=20.0), 0.8 * U)
