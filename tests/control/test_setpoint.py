"""Rates and thrust of a plan."""

from __future__ import annotations

import torch

from nsde_torch.control.controller import setpoints
from nsde_torch.control.reference import Reference
from nsde_torch.systems import Multirotor, System
from tests.helpers.control_problems import controller_of


def test_rates_are_those_that_the_plan_expects_ahead_and_thrust_is_that_of_its_inputs(
    declared: System, path: Reference
) -> None:
    controller = controller_of(declared)
    plan = controller.plan(path.at(torch.tensor([12.0])), path.window(12.0, dt=0.05, steps=20)[None])
    machine = controller.predictor.system
    assert isinstance(machine, Multirotor)
    wanted = setpoints(plan, machine, ahead=0.05)
    assert torch.allclose(wanted.rates, plan.x[:, 1:, 10:13])
    gain, offset = machine.value("thrust_gain"), machine.value("thrust_offset")
    assert torch.allclose(wanted.thrust, gain * plan.u.sum(2) + offset)
    between = setpoints(plan, machine, ahead=0.025).rates[:, 0]
    assert torch.allclose(between, 0.5 * (plan.x[:, 0, 10:13] + plan.x[:, 1, 10:13]))
