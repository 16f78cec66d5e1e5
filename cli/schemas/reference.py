"""Keys of the group `reference`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from nsde_torch.control.options import CircleOptions, HoverOptions, LemniscateOptions, WaypointOptions

from ..keys import key, mirrors, of


@dataclass
class ReferenceConfig:
    """Where to fly."""

    kind: str = key("???", "kind of the reference, set by reference=")
    check: bool = key(True, "refuse a reference that the machine cannot fly, by the model's account")
    tilt_limit: float = key(60.0, "largest tilt that the check lets pass", unit="deg", above=0, high=85)


@mirrors(CircleOptions)
class CircleReference(ReferenceConfig):
    """A circle."""

    kind: str = key("circle", "kind of the reference, set by reference=")


@mirrors(LemniscateOptions)
class LemniscateReference(ReferenceConfig):
    """A figure of eight."""

    kind: str = key("lemniscate", "kind of the reference, set by reference=")


@mirrors(HoverOptions)
class HoverReference(ReferenceConfig):
    """Standing still."""

    kind: str = key("hover", "kind of the reference, set by reference=")


@dataclass
class WaypointReference(ReferenceConfig):
    """A minimum-snap path through points."""

    kind: str = key("waypoints", "kind of the reference, set by reference=")
    points: Any = key("???", "positions and headings: [[x, y, z], [x, y, z, yaw], ...]", unit="m, deg")
    times: list[float] | None = key(
        None, "when to be there, from 0; null: as fast as the limits allow", unit="s", low=0
    )
    speed: float = of(WaypointOptions, "speed")
    tilt: float = of(WaypointOptions, "tilt")


@dataclass
class CsvReference(ReferenceConfig):
    """A minimum-snap path through the rows of a file."""

    kind: str = key("csv", "kind of the reference, set by reference=")
    path: str = key("???", "CSV file with p_x p_y p_z [m], and if there are yaw [rad] and t [s]", file=True)
    speed: float = of(WaypointOptions, "speed", help="largest speed, where the file has no times")
    tilt: float = of(WaypointOptions, "tilt", help="largest tilt, where the file has no times")
