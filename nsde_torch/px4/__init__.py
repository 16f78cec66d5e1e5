"""PX4: a MAVLink 2 link, an offboard state machine that flies a controller on it, and a simulated autopilot.

NED world and FRD body exist inside this package only; `frames` converts at its border, once.
"""

from typing import TYPE_CHECKING

from nsde_torch.lazy import names, resolver

if TYPE_CHECKING:
    from nsde_torch.px4.flight.cascade import CascadeController, PathPoints
    from nsde_torch.px4.flight.flying import FlightReport, fly
    from nsde_torch.px4.flight.predictive import PredictiveController
    from nsde_torch.px4.flight.safety import FlightOutcome
    from nsde_torch.px4.link.connection import Link, open_link
    from nsde_torch.px4.options import FlightOptions, Limits, SetpointLimits
    from nsde_torch.px4.simulator.simulated import Vehicle, fly_simulated

__all__ = names(__name__)
__getattr__ = resolver(__name__)
