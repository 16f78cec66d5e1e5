"""What a controller is to the link: a callable from a state and a time to body rates and collective thrust."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from nsde_torch.px4.link.vectors import Vec, between

TIPPED = "tipped"
"""Word of a status: a plan tilted too far."""


@dataclass(frozen=True)
class Demand:
    """What is asked of the vehicle at one time."""

    w: Vec  # body rates, FLU [rad/s]
    thrust: float  # collective thrust over mass, along the body's z axis [m/s2]


@dataclass(frozen=True)
class DemandPlan:
    """What a controller returns: demands from now on."""

    time: float  # from when the first demand holds, on our clock [s]
    dt: float  # time between demands [s]
    demands: tuple[Demand, ...]
    """One or more; between two of them both are mixed, the last one holds for `dt`."""
    status: str = "ok"
    """One word or two; `failed` in it means that the controller itself does not trust it, `TIPPED` that the plan that
    it replaces tilted too far."""
    solve_ms: float = 0.0  # time that it took

    def at(self, time: float) -> Demand:
        """The demand at a time; before the first and after the last those two."""
        s = max((time - self.time) / self.dt, 0.0)
        k = int(s)
        if k >= len(self.demands) - 1:
            return self.demands[-1]
        a, b, share = self.demands[k], self.demands[k + 1], s - k
        return Demand(between(a.w, b.w, share), a.thrust + share * (b.thrust - a.thrust))


Asked = Sequence[tuple[float, Demand]]
"""What was sent lately, and when it left [s], the oldest first."""


class FlightController(Protocol):
    """What plans."""

    def __call__(self, row: tuple[float, ...], time: float, t: float, asked: Asked = ()) -> DemandPlan:
        """Plan.

        Args:
            row: State, ENU and FLU.
            time: When it was valid, on our clock [s].
            t: The same time counted from the start of the reference [s].
            asked: What was sent lately, as it left.
        """
