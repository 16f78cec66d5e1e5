"""Writes flights as PX4's ULog (PX4 user guide, "ULog File Format"); pyulog reads it, but writes only copies of logs.

    header: "ULog" 01 12 35, version 1, time u64;      message: size u16, type u8, payload

with B (flags), F (formats), I (information), A (a topic gets a number) and D (its data). Topics bear PX4's
names and fields, as far as a log of states, commands and setpoints has them, in NED and FRD.
"""

from __future__ import annotations

import struct
from io import BufferedWriter
from math import isfinite, nan
from pathlib import Path
from typing import final

from nsde_torch.px4.link import frames
from nsde_torch.px4.link.vectors import Quat, Vec

_MAGIC = bytes((0x55, 0x4C, 0x6F, 0x67, 0x01, 0x12, 0x35, 1))
_NED = 1
_MOTORS = 12
_TOPICS: dict[str, tuple[str, str]] = {
    "vehicle_odometry": (
        "uint64_t timestamp;uint64_t timestamp_sample;float[3] position;float[4] q;float[3] velocity;"
        "float[3] angular_velocity;uint8_t pose_frame;uint8_t velocity_frame;",
        "<QQ3f4f3f3fBB",
    ),
    "actuator_motors": (
        f"uint64_t timestamp;uint64_t timestamp_sample;float[{_MOTORS}] control;",
        f"<QQ{_MOTORS}f",
    ),
    "vehicle_rates_setpoint": (
        "uint64_t timestamp;float roll;float pitch;float yaw;float[3] thrust_body;",
        "<Q3f3f",
    ),
    "battery_status": ("uint64_t timestamp;float voltage_v;", "<Qf"),
}
"""Fields of each topic, and their bytes."""
_NUMBERS = {name: k for k, name in enumerate(_TOPICS)}


@final
class UlogFile:
    """One log; nothing is on disk before the first state."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self._out: BufferedWriter | None = None

    def state(self, stamp: float, p: Vec, v: Vec, q: Quat, w: Vec) -> None:
        """A state, ENU and FLU, at a time of the autopilot's clock [s]."""
        if self._out is None:
            self._begin(stamp)
        us = round(stamp * 1e6)
        ned = (*frames.world(p), *frames.attitude(q), *frames.world(v), *frames.body(w))
        self._data("vehicle_odometry", us, us, *ned, _NED, _NED)

    def motors(self, stamp: float, u: tuple[float, ...]) -> None:
        """Motor commands, 0 to 1; left out while they are not known."""
        if all(map(isfinite, u)):
            us = round(stamp * 1e6)
            self._data("actuator_motors", us, us, *u, *(nan,) * (_MOTORS - len(u)))

    def setpoint(self, stamp: float, w: Vec, throttle: float) -> None:
        """Body rates, FLU [rad/s], and throttle that were asked for."""
        self._data("vehicle_rates_setpoint", round(stamp * 1e6), *frames.body(w), 0.0, 0.0, -throttle)

    def voltage(self, stamp: float, volts: float) -> None:
        """Of the battery [V]."""
        if isfinite(volts):
            self._data("battery_status", round(stamp * 1e6), volts)

    def flush(self) -> None:
        """Put what was written on disk."""
        if self._out is not None:
            self._out.flush()

    def close(self) -> None:
        """End the log."""
        if self._out is not None:
            self._out.close()
            self._out = None

    def _begin(self, stamp: float) -> None:
        self.file.parent.mkdir(parents=True, exist_ok=True)
        self._out = self.file.open("wb")
        self._out.write(_MAGIC + struct.pack("<Q", round(stamp * 1e6)))
        self._message("B", bytes(40))
        for name, (fields, _) in _TOPICS.items():
            self._message("F", f"{name}:{fields}".encode())
        for key, value in (("sys_name", "PX4"), ("replay_source", "nsde fly")):
            text = f"char[{len(value)}] {key}".encode()
            self._message("I", bytes((len(text),)) + text + value.encode())
        for name, number in _NUMBERS.items():
            self._message("A", struct.pack("<BH", 0, number) + name.encode())

    def _data(self, topic: str, *values: float) -> None:
        self._message("D", struct.pack("<H", _NUMBERS[topic]) + struct.pack(_TOPICS[topic][1], *values))

    def _message(self, kind: str, payload: bytes) -> None:
        assert self._out is not None
        self._out.write(struct.pack("<HB", len(payload), ord(kind)) + payload)
