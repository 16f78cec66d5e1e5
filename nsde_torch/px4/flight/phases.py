"""The phases of a flight, and how one ended."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from nsde_torch.px4.flight.safety import EstimateStep, Trouble


class Phase(Enum):
    """Where in the flight we are."""

    CONNECT = "connect"
    PREFLIGHT = "preflight"
    STREAM = "stream"
    OFFBOARD = "offboard"
    ARM = "arm"
    TAKEOFF = "take off"
    HOLD = "hold"
    TRACK = "track"
    RETURN = "return"
    SAFE_HOLD = "safe hold"
    BLIND = "blind"
    LAND = "land"
    DISARM = "disarm"
    WATCH = "watch"
    DONE = "done"


FLYING = (Phase.TAKEOFF, Phase.HOLD, Phase.TRACK, Phase.RETURN, Phase.SAFE_HOLD)
"""Phases in which we fly the vehicle and it must be in OFFBOARD."""


REFUSED = "refused"
"""Kind of the trouble of a flight that was not begun."""


@dataclass
class FlightOutcome:
    """How a flight ended."""

    tracked: bool = False  # the reference was flown to its end
    landed: bool = False  # on the ground and disarmed, as telemetry says
    trouble: Trouble | None = None  # the first thing that went wrong
    actions: list[tuple[float, str, str]] = field(default_factory=list)
    """The phases of the flight, with their times from the start [s] and the reason."""
    without_plans: float = 0.0
    """Time for which the built-in cascade flew the reference, because plans were late [s]."""
    steps: list[tuple[float, EstimateStep]] = field(default_factory=list)
    """Resets of the estimate in flight, with their times from the start [s]."""

    @property
    def begun(self) -> bool:
        """Whether it came to arming or was taken over; before that, and where it was refused, nothing was moved."""
        refused = self.trouble is not None and self.trouble.kind == REFUSED
        return not refused and any(
            phase in (Phase.ARM.value, Phase.HOLD.value) for _, phase, _ in self.actions
        )
