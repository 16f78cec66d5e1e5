"""The log of a flight: a CSV data set as `nsde diagnose` reads it, written while it flies.

One row a state, on the autopilot's clock: state (ENU from the place of take-off, FLU), the motors' commands as the
autopilot reports them, then what was asked for (`rate_sp_*` [rad/s], `throttle_sp`) and `battery_voltage` [V]. What is
not known is `nan`. Beside it the same flight as ULog, for PX4's tools.
"""

from __future__ import annotations

import struct
from io import TextIOWrapper
from math import isfinite, nan
from pathlib import Path
from typing import final

from nsde_torch.px4.link import frames
from nsde_torch.px4.link.telemetry import VehicleState
from nsde_torch.px4.link.vectors import Vec

Sent = tuple[float, Vec, float] | None  # time, rates and throttle of a setpoint; None where there was none
STATE = ("p_x", "p_y", "p_z", "v_x", "v_y", "v_z", "q_w", "q_x", "q_y", "q_z", "w_x", "w_y", "w_z")
EXTRA = ("rate_sp_x", "rate_sp_y", "rate_sp_z", "throttle_sp", "battery_voltage")
RESET = 0.05
"""Time after a reset of the estimate that is left out, so that the run is cut there: no motion made that step [s]."""


@final
class FlightLog:
    """Writes one run of a vehicle with some motors; a context manager. File and folder are made with the first row."""

    def __init__(self, file: Path, motors: int) -> None:
        self.file, self._motors = file, motors
        self._out: TextIOWrapper | None = None
        self._ulog: UlogFile | None = None
        self._last = -1.0
        self._resets, self._from = 0, -1.0
        self._flushed = 0.0
        self.rows = 0

    def __enter__(self) -> FlightLog:
        return self

    def __exit__(self, *error: object) -> None:
        if self._out is not None and self._ulog is not None:
            self._out.close()
            self._ulog.close()
            self._out = self._ulog = None

    def add(self, state: VehicleState, motors: tuple[float, ...], voltage: float, sent: Sent) -> None:
        """Log a state, once, with the motors' commands and the battery's voltage [V] as they were known when it came,
        and what had left last."""
        if state.stamp <= self._last:
            return
        self._last = state.stamp
        if state.resets != self._resets:
            self._resets, self._from = state.resets, state.stamp + RESET
        if state.stamp < self._from:
            return
        if self._out is None or self._ulog is None:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            self._out = self.file.open("w", encoding="utf-8", newline="\n")
            self._ulog = UlogFile(self.file.with_suffix(".ulg"), state.stamp)
            names = (f"u_{k + 1}" for k in range(self._motors))
            self._out.write(",".join(("t", *STATE, *names, *EXTRA)) + "\n")
        known = motors[: self._motors]
        u = known if len(known) == self._motors else (nan,) * self._motors
        asked = (*sent[1], sent[2]) if sent is not None else (nan,) * 4
        values = (round(state.stamp, 6), *state.row, *u, *asked, voltage)
        self._out.write(",".join(f"{v:.7g}" if k else repr(v) for k, v in enumerate(values)) + "\n")
        self._ulog.add(state, u, sent, voltage)
        self.rows += 1
        if state.received - self._flushed > 1.0:
            self._flushed = state.received
            self._out.flush()
            self._ulog.flush()


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
    """One log that begins at a stamp [s], in a folder that is there."""

    def __init__(self, file: Path, stamp: float) -> None:
        self._out = file.open("wb")
        self._out.write(_MAGIC + struct.pack("<Q", round(stamp * 1e6)))
        self.flush, self.close = self._out.flush, self._out.close
        self._message("B", bytes(40))
        for name, (fields, _) in _TOPICS.items():
            self._message("F", f"{name}:{fields}".encode())
        for key, value in (("sys_name", "PX4"), ("replay_source", "nsde fly")):
            text = f"char[{len(value)}] {key}".encode()
            self._message("I", bytes((len(text),)) + text + value.encode())
        for name, number in _NUMBERS.items():
            self._message("A", struct.pack("<BH", 0, number) + name.encode())

    def add(self, state: VehicleState, u: tuple[float, ...], sent: Sent, volts: float) -> None:
        """A state, motor commands (0 to 1), a setpoint and the battery's voltage, each where it is known."""
        us = round(state.stamp * 1e6)
        place = (*frames.world(state.p), *frames.attitude(state.q))
        ned = (*place, *frames.world(state.v), *frames.body(state.w))
        self._data("vehicle_odometry", us, us, *ned, _NED, _NED)
        if all(map(isfinite, u)):
            self._data("actuator_motors", us, us, *u, *(nan,) * (_MOTORS - len(u)))
        if sent is not None:
            self._data("vehicle_rates_setpoint", us, *frames.body(sent[1]), 0.0, 0.0, -sent[2])
        if isfinite(volts):
            self._data("battery_status", us, volts)

    def _data(self, topic: str, *values: float) -> None:
        self._message("D", struct.pack("<H", _NUMBERS[topic]) + struct.pack(_TOPICS[topic][1], *values))

    def _message(self, kind: str, payload: bytes) -> None:
        self._out.write(struct.pack("<HB", len(payload), ord(kind)) + payload)
