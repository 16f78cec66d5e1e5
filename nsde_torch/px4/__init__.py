"""PX4: a MAVLink 2 link, an offboard state machine that flies a controller on it, and a simulated autopilot.

NED world and FRD body exist inside this package only; `frames` converts at its border, once.
"""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.px4.flight import FlightReport, fly
    from nsde_torch.px4.link import Link, open_link
    from nsde_torch.px4.offboard import Outcome
    from nsde_torch.px4.options import FlightOptions, Limits, SetpointLimits
    from nsde_torch.px4.path import CascadeController, PathPoints
    from nsde_torch.px4.predictive import PredictiveController
    from nsde_torch.px4.simulated import fly_simulated
    from nsde_torch.px4.vehicle import Vehicle

__all__ = [
    "CascadeController",
    "FlightOptions",
    "FlightReport",
    "Limits",
    "Link",
    "Outcome",
    "PathPoints",
    "PredictiveController",
    "SetpointLimits",
    "Vehicle",
    "fly",
    "fly_simulated",
    "open_link",
]

__getattr__ = resolver(
    __name__,
    {
        "CascadeController": "path",
        "FlightOptions": "options",
        "FlightReport": "flight",
        "Limits": "options",
        "Link": "link",
        "Outcome": "offboard",
        "PathPoints": "path",
        "PredictiveController": "predictive",
        "SetpointLimits": "options",
        "Vehicle": "vehicle",
        "fly": "flight",
        "fly_simulated": "simulated",
        "open_link": "link",
    },
)
