"""What a low-level controller of body rates is told, from a plan: desired rates and collective thrust.

The supplement's flights send rates and not motor commands, because of latency: the rates that the plan expects a little
ahead are wanted now, and its inputs give the thrust.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from nsde_torch.control.controller import Plan
from nsde_torch.systems import Multirotor


class Setpoints(NamedTuple):
    """Wanted by a plan at the beginning of each of its steps.

    Args:
        rates: Body rates, FLU (N, K, 3) [rad/s].
        thrust: Collective thrust over mass (N, K) [m/s2].
    """

    rates: Tensor
    thrust: Tensor


def setpoints(plan: Plan, system: Multirotor, *, ahead: float) -> Setpoints:
    """Rates and thrust along a plan.

    Args:
        plan: The plan.
        system: Its machine.
        ahead: How far ahead the rates are taken from [s], because they are reached late.
    """
    later = plan.shifted(max(ahead, 0.0))
    n, steps, _ = plan.u.shape
    thrust = system.quantity("thrust", plan.x[:, :-1].flatten(0, 1), plan.u.flatten(0, 1))
    return Setpoints(rates=later.z[:, 0, :-1, 10:13], thrust=thrust[:, 0].view(n, steps))
