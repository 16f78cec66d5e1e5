"""A reference as points for the cascade, moved to where the vehicle took off."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import final

import numpy as np

from nsde_torch.control.reference import FlightPath
from nsde_torch.px4.flight.cascade import Point, SetpointCascade
from nsde_torch.px4.flight.controller import Asked, Demand, DemandPlan
from nsde_torch.px4.link.vectors import Vec

PAUSE = 0.5
"""Time without a state after which a flight is a new one [s]."""
LEAD = 0.1
"""How much earlier than needed the cascade asks for accelerations [s]."""


@final
class PathPoints:
    """Points of a path by time; before its start and after its end at rest."""

    def __init__(self, path: FlightPath) -> None:
        self.name, self.duration, self._dt = path.name, path.duration, path.dt
        yaw_rate = np.gradient(path.yaw, path.dt)
        self._rows = np.column_stack((path.p, path.v, path.a, path.yaw, yaw_rate)).tolist()
        self.speed = float(np.linalg.norm(path.v, axis=1).max())
        self.low: Vec = tuple(path.p.min(0).tolist())
        self.high: Vec = tuple(path.p.max(0).tolist())

    def at(self, t: float) -> Point:
        """The point at a time [s]."""
        s = t / self._dt
        if s <= 0.0 or s >= len(self._rows) - 1:
            row = self._rows[0 if s <= 0.0 else -1]
            return Point((row[0], row[1], row[2]), yaw=row[9])
        k = int(s)
        share = s - k
        r = [a + share * (b - a) for a, b in zip(self._rows[k], self._rows[k + 1], strict=True)]
        return Point((r[0], r[1], r[2]), (r[3], r[4], r[5]), (r[6], r[7], r[8]), r[9], r[10])

    def led(self, t: float, lead: float) -> Point:
        """The point at a time, with the acceleration and heading of a lead later, because attitude follows late [s]."""
        now, soon = self.at(t), self.at(t + lead)
        return Point(now.p, now.v, soon.a, soon.yaw, now.yaw_rate)


@final
@dataclass(eq=False)
class CascadeController:
    """The cascade along a path, as a `FlightController`."""

    path: PathPoints  # points, in the controller's own coordinates
    _: KW_ONLY
    lead: float = LEAD  # see `PathPoints.led` [s]

    def __post_init__(self) -> None:
        self._cascade = SetpointCascade()
        self._last: float | None = None

    def __call__(self, row: tuple[float, ...], time: float, t: float, asked: Asked = ()) -> DemandPlan:
        """See `FlightController`."""
        dt = 0.0 if self._last is None else time - self._last
        if abs(dt) > PAUSE:
            self._cascade.reset()
        dt = min(max(dt, 0.0), 0.05)
        self._last = time
        to = self.path.led(t, self.lead)
        demand: Demand = self._cascade(row[0:3], row[3:6], row[6:10], to, dt)  # type: ignore[arg-type]
        return DemandPlan(time, 0.05, (demand,), "cascade")
