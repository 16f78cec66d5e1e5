"""Keys of the group `reference`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from nsde_torch.control.options import (
    CircleOptions,
    HoverOptions,
    LemniscateOptions,
    SetpointOptions,
    WaypointOptions,
)

from ..keys import key, mirrors, of


@dataclass
class ReferenceConfig:
    """Where to fly."""

    kind: str = key("???", "kind of the reference, set by reference=")
    check: bool = key(True, "refuse a reference that the machine cannot fly, by the model's account")
    tilt_limit: float = key(60.0, "largest tilt that the check lets pass", unit="deg", above=0, high=85)


def _keys_of(kind: str, options: type) -> type:
    """Keys for every option of a path that has nothing else."""
    space = {
        "__annotations__": {"kind": "str"},
        "__doc__": options.__doc__,
        "__module__": __name__,
        "kind": key(kind, "kind of the reference, set by reference="),
    }
    return mirrors(options)(type(f"{kind.title()}Reference", (ReferenceConfig,), space))


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
class SetpointReference(ReferenceConfig):
    """A state to reach and to hold, of any machine."""

    kind: str = key("setpoint", "kind of the reference, set by reference=")
    states: Any = key({}, "values of states, {theta: 0}; others are 0, a quaternion level")
    duration: float = of(SetpointOptions, "duration")


@dataclass
class CsvReference(ReferenceConfig):
    """A minimum-snap path through the rows of a file; of another machine than a multirotor, states over time."""

    kind: str = key("csv", "kind of the reference, set by reference=")
    path: str = key(
        "???",
        "CSV file with p_x p_y p_z [m], and if there are yaw [rad] and t [s]; of other machines with t and states",
        file=True,
    )
    speed: float = of(WaypointOptions, "speed", help="largest speed, where the file has no times")
    tilt: float = of(WaypointOptions, "tilt", help="largest tilt, where the file has no times")


REFERENCE_CHOICES: dict[str, type] = {
    "circle": _keys_of("circle", CircleOptions),
    "lemniscate": _keys_of("lemniscate", LemniscateOptions),
    "hover": _keys_of("hover", HoverOptions),
    "setpoint": SetpointReference,
    "waypoints": WaypointReference,
    "csv": CsvReference,
}
# a configuration that a sweep sends to another process finds its class by name
globals().update({cls.__name__: cls for cls in REFERENCE_CHOICES.values()})
