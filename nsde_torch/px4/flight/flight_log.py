"""The log of a flight: a CSV data set as `nsde diagnose` reads it, written while it flies.

One row a state, on the autopilot's clock: state (ENU from the place of take-off, FLU), the motors' commands as the
autopilot reports them, then what was asked for (`rate_sp_*` [rad/s], `throttle_sp`) and `battery_voltage` [V]. What is
not known is `nan`. Beside it the same flight as ULog, for PX4's tools.
"""

from __future__ import annotations

from io import TextIOWrapper
from math import nan
from pathlib import Path
from typing import final

from nsde_torch.px4.flight.ulog_file import UlogFile
from nsde_torch.px4.link.telemetry import VehicleState
from nsde_torch.px4.link.vectors import Vec

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
        self._ulog = UlogFile(file.with_suffix(".ulg"))
        self._last = -1.0
        self._resets, self._from = 0, -1.0
        self._flushed = 0.0
        self.rows = 0

    def __enter__(self) -> FlightLog:
        return self

    def __exit__(self, *error: object) -> None:
        if self._out is not None:
            self._out.close()
            self._out = None
        self._ulog.close()

    def add(
        self,
        state: VehicleState,
        motors: tuple[float, ...],
        voltage: float,
        sent: tuple[float, Vec, float] | None,
    ) -> None:
        """Log a state, once, with the motors' commands and the battery's voltage [V] as they were known when it came,
        and the time, rates and throttle that had left last."""
        if state.stamp <= self._last:
            return
        self._last = state.stamp
        if state.resets != self._resets:
            self._resets, self._from = state.resets, state.stamp + RESET
        if state.stamp < self._from:
            return
        if self._out is None:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            self._out = self.file.open("w", encoding="utf-8", newline="\n")
            names = (f"u_{k + 1}" for k in range(self._motors))
            self._out.write(",".join(("t", *STATE, *names, *EXTRA)) + "\n")
        known = motors[: self._motors]
        u = known if len(known) == self._motors else (nan,) * self._motors
        asked = (*sent[1], sent[2]) if sent is not None else (nan,) * 4
        values = (round(state.stamp, 6), *state.row, *u, *asked, voltage)
        self._out.write(",".join(f"{v:.7g}" if k else repr(v) for k, v in enumerate(values)) + "\n")
        self._ulog.state(state.stamp, state.p, state.v, state.q, state.w)
        self._ulog.motors(state.stamp, u)
        if sent is not None:
            self._ulog.setpoint(state.stamp, sent[1], sent[2])
        self._ulog.voltage(state.stamp, voltage)
        self.rows += 1
        if state.received - self._flushed > 1.0:
            self._flushed = state.received
            self._out.flush()
            self._ulog.flush()
