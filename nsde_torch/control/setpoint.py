"""What a low-level controller of body rates is told, from a plan: desired rates and collective thrust.

The supplement's flights send rates and not motor commands, because of latency: the rates that the plan expects a little
ahead are wanted now, and the mean of its inputs is the thrust.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from nsde_torch.control.controller import Plan


class Setpoint(NamedTuple):
    """Wanted by a plan.

    Args:
        rates: Body rates, FLU (N, 3) [rad/s].
        thrust: Mean command of the motors (N,), in [0, 1].
    """

    rates: Tensor
    thrust: Tensor


def setpoint(plan: Plan, *, ahead: float | None = None) -> Setpoint:
    """Rates and thrust of a plan.

    Args:
        plan: The plan.
        ahead: How far ahead the rates are taken from [s]; None: one step of the plan.
    """
    time = plan.dt if ahead is None else ahead
    later = plan.shifted(max(time, 0.0))
    return Setpoint(rates=later.z[:, 0, 0, 10:13], thrust=plan.u[:, 0].mean(1))
