"""Keys of the limits of a flight over MAVLink."""

from __future__ import annotations

from typing import Any

from nsde_torch.px4.flight.options import Limits, SetpointLimits

from ..keys import mirrors, of


@mirrors(Limits, without=("heartbeat", "patience"))
class LimitsConfig:
    """When something is wrong in flight; what is done about it is in the documentation of nsde fly."""

    fence: Any = of(Limits, "fence")
    rate: float = of(SetpointLimits, "rate")
    yaw_rate: float = of(SetpointLimits, "yaw_rate")
    throttle: list[float] = of(SetpointLimits, "throttle")
