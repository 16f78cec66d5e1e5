"""Rates and thrust of a plan."""

from __future__ import annotations

import torch

from nsde_torch.control.reference import Reference
from nsde_torch.control.setpoint import setpoint
from nsde_torch.systems import System
from tests.helpers.control_problems import controller_of


def test_rates_are_those_that_the_plan_expects_ahead_and_thrust_is_the_mean_command(
    declared: System, path: Reference
) -> None:
    controller = controller_of(declared)
    plan = controller.plan(path.at(torch.tensor([12.0])), path.window(12.0, dt=0.05, steps=20)[None])
    wanted = setpoint(plan)
    assert torch.allclose(wanted.rates, plan.x[:, 1, 10:13])
    assert torch.allclose(wanted.thrust, plan.u[:, 0].mean(1))
    between = setpoint(plan, ahead=0.025).rates
    assert torch.allclose(between, 0.5 * (plan.x[:, 0, 10:13] + plan.x[:, 1, 10:13]))
