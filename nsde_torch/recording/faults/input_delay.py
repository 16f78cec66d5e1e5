"""States late, all of them: x_log(t) = x(t - d), so that the log shows inputs a time d before they act.

No kinematics show it; in physics it is what an effect `input_delay` is too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, final

from nsde_torch.options import key
from nsde_torch.recording.faults.fault import Fault

if TYPE_CHECKING:
    import numpy as np

    from nsde_torch.data.raw import RawRun
    from nsde_torch.data.system_info import SystemInfo


@final
class LateStates(Fault):
    """See the module."""

    name = "input_delay"
    rank = 40
    option = key(
        0.0, "time by which states are logged late, so that inputs seem to come early", unit="s", low=0
    )
    mixes_times = True

    def rows_before(self, value: Any, dt: float) -> int:
        """See `Fault.rows_before`."""
        return round(value / dt)

    def simulate(
        self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: np.random.Generator
    ) -> None:
        """See `Fault.simulate`."""
        import numpy as np

        rows = round(value / dt)
        if rows:
            run.x = np.concatenate([np.repeat(run.x[:1], rows, axis=0), run.x[:-rows]])

    def describe(self, value: Any, *, dt: float) -> dict[str, Any]:
        """See `Fault.describe`."""
        rows = round(value / dt)
        return {"input_delay_s": rows * dt} if rows else {}
