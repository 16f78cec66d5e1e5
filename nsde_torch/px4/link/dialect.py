"""The MAVLink dialect, and the numbers of PX4 that it does not name.

Modes: `px4_custom_mode.h` of PX4 packs main mode and sub mode into bytes 3 and 4 of HEARTBEAT's `custom_mode`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from types import ModuleType

from pymavlink.dialects.v20 import common

mavlink: ModuleType = common

SET_MODE, ARM, SET_INTERVAL, REQUEST_MESSAGE = 176, 400, 511, 512
"""Numbers of commands: MAV_CMD_DO_SET_MODE, _COMPONENT_ARM_DISARM, _SET_MESSAGE_INTERVAL, _REQUEST_MESSAGE."""
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED = 0, 1, 2, 3
ARMED_FLAG, RECEIVER = 128, 65536
"""Bits of HEARTBEAT's `base_mode`, and of SYS_STATUS' sensors: PX4 sets the second while it hears a transmitter."""
GCS = 6
"""Type of a ground station's heartbeat. PX4 sends STATUSTEXT only to a link on which a ground station is heard."""
AUTOPILOT_PX4, NO_AUTOPILOT = 12, 8
RATES_MASK = 128  # type mask of SET_ATTITUDE_TARGET: attitude ignored
ON_GROUND, IN_AIR, TAKING_OFF, LANDING = 1, 2, 3, 4


@dataclass(frozen=True)
class Mode:
    """A flight mode of PX4."""

    main: int
    sub: int = 0

    @property
    def custom(self) -> int:
        """As HEARTBEAT carries it."""
        return self.main << 16 | self.sub << 24

    @classmethod
    def of(cls, custom: int) -> Mode:
        """From HEARTBEAT's `custom_mode`."""
        return cls(custom >> 16 & 0xFF, custom >> 24 & 0xFF)

    def __str__(self) -> str:
        return NAMES.get(self, f"mode {self.main}.{self.sub}")


UNKNOWN = Mode(0)
MANUAL, ALTITUDE, POSITION, OFFBOARD = Mode(1), Mode(2), Mode(3), Mode(6)
TAKEOFF, HOLD, MISSION, RETURN, LAND = Mode(4, 2), Mode(4, 3), Mode(4, 4), Mode(4, 5), Mode(4, 6)
NAMES = {
    **{MANUAL: "MANUAL", ALTITUDE: "ALTITUDE", POSITION: "POSITION", OFFBOARD: "OFFBOARD"},
    **{TAKEOFF: "TAKEOFF", HOLD: "HOLD", MISSION: "MISSION", RETURN: "RETURN", LAND: "LAND"},
}

REAL32, INT32 = 9, 6


def parameter_value(number: float, kind: int) -> float:
    """Value of a parameter: PX4 puts the bytes of whole numbers into the field for floats."""
    if kind == REAL32:
        return number
    return float(struct.unpack("<i", struct.pack("<f", number))[0])


def parameter_number(value: float, kind: int) -> float:
    """The inverse of `parameter_value`."""
    if kind == REAL32:
        return float(value)
    return float(struct.unpack("<f", struct.pack("<i", int(value)))[0])
