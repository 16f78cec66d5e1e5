"""A filtered sensor: T x_log' + x_log = x for some of the states.

It is late by T at low frequencies; what it leaves once it is undone tells it from a delay
(`nsde_torch.recording.lateness`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, final

from nsde_torch.options import key
from nsde_torch.recording.faults.fault import Fault

if TYPE_CHECKING:
    import numpy as np

    from nsde_torch.data.raw import RawRun
    from nsde_torch.data.run import Run
    from nsde_torch.data.system_info import SystemInfo
    from nsde_torch.recording.log import Detected, LoggedRuns, Suspect

_HOW = "late behind a filter, against"


@final
class SensorLag(Fault):
    """See the module."""

    name = "sensor_lag"
    rank = 20
    stage = "lateness"
    option = key(
        {}, "time constant of a filter that a state goes through, recording.sensor_lag.STATE=0.02", unit="s"
    )
    annotation = Mapping[str, float]
    remedy = key({}, "time constants of filters that states went through, {STATE: 0.02}, to undo", unit="s")
    mixes_times = True

    def check(self, value: Any, system: SystemInfo) -> None:
        """See `Fault.check`."""
        from nsde_torch.recording.channels import check_times

        check_times(self.name, value, system)

    def simulate(
        self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: np.random.Generator
    ) -> None:
        """See `Fault.simulate`."""
        from nsde_torch.recording.channels import changed, filtered

        run.x = changed(run.x, system, value, lambda x, lag: filtered(x, lag / dt))

    def describe(self, value: Any, *, dt: float) -> dict[str, Any]:
        """See `Fault.describe`."""
        return {"sensor_lag_s": {k: v for k, v in value.items() if v}}

    def detect(self, log: LoggedRuns) -> Detected | None:
        """See `Fault.detect`."""
        from nsde_torch.recording.late_sensor import told

        return told(self.name, [d for d in log.surely if d.filtered], _HOW)

    def suspects(self, log: LoggedRuns) -> list[Suspect]:
        """See `Fault.suspects`."""
        from nsde_torch.recording.late_sensor import suspected

        return suspected(self, log, filtered=True, how=_HOW)

    def undo(self, run: Run, system: SystemInfo, values: Mapping[str, float]) -> Run:
        """See `Fault.undo`."""
        from nsde_torch.recording.channels import on_time

        return on_time(run, system, {}, values)
