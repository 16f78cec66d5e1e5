"""A late sensor: x_log(t) = x(t - d) for some of the states.

A position is late against the integral of its rate, or the rate against it (`nsde_torch.recording.lateness`). One whose
position and rate are late alike shows in physics alone (`nsde_torch.recording.late_sensor`).
"""

from __future__ import annotations

from collections.abc import Mapping
from math import ceil
from typing import TYPE_CHECKING, Any, final

from nsde_torch.options import key
from nsde_torch.recording.faults.fault import Fault

if TYPE_CHECKING:
    import numpy as np

    from nsde_torch.data.raw import RawRun
    from nsde_torch.data.run import Run
    from nsde_torch.data.system_info import SystemInfo
    from nsde_torch.recording.log import Detected, LoggedRuns, Misfits, Recorded, Suspect


@final
class SensorDelay(Fault):
    """See the module."""

    name = "sensor_delay"
    rank = 30
    stage = "lateness"
    option = key(
        {},
        "by how much a state is logged late, recording.sensor_delay.STATE=0.02 (p for p_x p_y p_z)",
        unit="s",
    )
    annotation = Mapping[str, float]
    remedy = key(
        {},
        "by how much states are logged late, {STATE: 0.01}, or {p: 0.01} for p_x p_y p_z, to take out",
        unit="s",
    )
    mixes_times = True

    def check(self, value: Any, system: SystemInfo) -> None:
        """See `Fault.check`."""
        from nsde_torch.recording.channels import check_times

        check_times(self.name, value, system)

    def rows_before(self, value: Any, dt: float) -> int:
        """See `Fault.rows_before`."""
        return ceil(max(value.values(), default=0.0) / dt - 1e-9)

    def simulate(
        self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: np.random.Generator
    ) -> None:
        """See `Fault.simulate`."""
        from nsde_torch.recording.channels import changed, moved

        run.x = changed(run.x, system, value, lambda x, delay: moved(x, -delay / dt))

    def describe(self, value: Any, *, dt: float) -> dict[str, Any]:
        """See `Fault.describe`."""
        return {"sensor_delay_s": {k: v for k, v in value.items() if v}}

    def detect(self, log: LoggedRuns) -> Detected | None:
        """See `Fault.detect`."""
        from nsde_torch.recording.late_sensor import told

        return told(self.name, [d for d in log.surely if not d.filtered], "later than")

    def suspects(self, log: LoggedRuns) -> list[Suspect]:
        """See `Fault.suspects`: moved the other way a channel would be as smooth."""
        from nsde_torch.recording.late_sensor import suspected

        return suspected(self, log, filtered=False, how="later than")

    def instead_of_effects(
        self, found: Recorded, system: SystemInfo, misfits: Misfits, *, rows: int, other: float
    ) -> Recorded | None:
        """See `Fault.instead_of_effects`."""
        from nsde_torch.recording.late_sensor import late_sensor

        return late_sensor(found, system, misfits, rows=rows, other=other)

    def undo(self, run: Run, system: SystemInfo, values: Mapping[str, float]) -> Run:
        """See `Fault.undo`."""
        from nsde_torch.recording.channels import on_time

        return on_time(run, system, values)
