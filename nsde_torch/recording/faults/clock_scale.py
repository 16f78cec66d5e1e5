"""A wrong clock: rows are `scale` times as far apart as their times say.

p and q move as far as v and omega say only if a logged second is that many seconds (`nsde_torch.data.kinematics`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, final

from nsde_torch.options import key
from nsde_torch.recording.faults.fault import Fault

if TYPE_CHECKING:
    import numpy as np

    from nsde_torch.data.raw import RawRun
    from nsde_torch.data.system_info import SystemInfo
    from nsde_torch.recording.log import Detected, LoggedRuns

_FOLDS = 10  # of the jackknife in data.kinematics


@final
class ClockScale(Fault):
    """See the module. The reader decides on a scale; here it is told whether that is surely a fault."""

    name = "clock_scale"
    rank = 10
    stage = "clock"
    option = key(1.0, "physical seconds for each logged second", low=0.5, high=2)

    def clock(self, value: Any) -> float:
        """See `Fault.clock`."""
        return float(value)

    def simulate(
        self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: np.random.Generator
    ) -> None:
        """The plant is sampled at steps that are `value` times as long (see `clock`); nothing is left to do."""

    def describe(self, value: Any, *, dt: float) -> dict[str, Any]:
        """See `Fault.describe`."""
        return {self.name: value}

    def detect(self, log: LoggedRuns) -> Detected | None:
        """See `Fault.detect`: the reader decides at three standard errors, however few intervals they are from."""
        from scipy.special import stdtr, stdtrit

        from nsde_torch.data.kinematics import pool
        from nsde_torch.data.system_info import derivative_columns, rate_columns
        from nsde_torch.recording.log import LEVEL, Detected

        clock, system = log.data.clock_scale, log.system
        if clock == 1.0:
            return None
        pooled = pool(log.data.summary.slopes)
        degrees = max(pooled.slopes - 1, _FOLDS - 1)  # errors of slopes are from so many folds each
        p = 2.0 * float(stdtr(degrees, -abs(pooled.value - 1.0) / max(pooled.error, 1e-12)))
        if p >= log.level(self.stage):
            return None
        half = float(stdtrit(degrees, 0.5 * (1 + LEVEL))) * pooled.error
        pairs = [
            (system.state_names[a], system.state_names[b])
            for i, j in derivative_columns(system).values()
            for a, b in zip(i, j, strict=True)
        ]
        turns = rate_columns(system) is not None
        single = len(pairs) == 1 and not turns
        what = "positions and attitude" if turns else " and ".join(position for position, _ in pairs)
        moves, says = ("moves", "its rate says") if single else ("move", "their rates say")
        rate, how = pairs[0][1], "further" if clock > 1.0 else "less far"
        return Detected(
            self.name,
            {"scale": (clock, clock - half, clock + half, "1")},
            p,
            f"A second of the log lasts {clock:.4g} s: {what} {moves} {how} than {says}.",
            clock=clock,
            ties=("sensor_scale",) if single else (),
            experiment="hold the time column against another clock over a few minutes; if it is right, "
            f"{rate} is logged {1 / clock:.4g} times too large: multiply it by {clock:.4g}"
            if single
            else "",
        )
