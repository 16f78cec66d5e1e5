"""Smoothed inputs: u_log(t) = mean of u over [t - w / 2, t + w / 2].

A moving average of width w leaves nulls at k / w in the spectrum of the inputs (`nsde_torch.recording.smoothing`).
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
    from nsde_torch.recording.log import Detected, LoggedRuns


@final
class InputSmoothing(Fault):
    """See the module."""

    name = "input_smoothing"
    rank = 60
    option = key(0.0, "width of the centred moving average of the inputs", unit="s", low=0)
    mixes_times = True

    def simulate(
        self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: np.random.Generator
    ) -> None:
        """See `Fault.simulate`."""
        from nsde_torch.recording.smoothing import averaged

        run.u = averaged(run.u, round(value / dt))

    def describe(self, value: Any, *, dt: float) -> dict[str, Any]:
        """See `Fault.describe`."""
        steps = round(value / dt)
        return {"input_smoothing_s": steps * dt} if steps else {}

    def detect(self, log: LoggedRuns) -> Detected | None:
        """See `Fault.detect`.

        Rows that were lost at a regular distance leave such nulls too, in the spectrum of held inputs: so the
        declared physics has to fit better with inputs that are restored.
        """
        from nsde_torch.recording.log import Detected
        from nsde_torch.recording.smoothing import smoothing_width

        width = smoothing_width(log.runs, log.nu) if log.nu else 0.0
        if not width > 0:
            return None
        dt = log.runs[0].dt
        found = Detected(
            self.name,
            {"width": (width, width - 0.5 * dt, width + 0.5 * dt, "s")},
            None,
            f"The log holds a moving average over {width:.3g} s of the inputs that acted.",
        )
        return found if log.misfit_with(self, found.plain) < log.misfit_with(self, {}) else None

    def undo(self, run: Run, system: SystemInfo, values: Mapping[str, float]) -> Run:
        """See `Fault.undo`."""
        from nsde_torch.recording.smoothing import restored

        for width in values.values():
            run = restored(run, len(system.input_names), width)
        return run
