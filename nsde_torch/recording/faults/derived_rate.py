"""Rates that were made of positions: v_log = W q_log, and no sensor's.

W is the difference from the row before, or the slope of a parabola through some rows (Savitzky and Golay, Analytical
Chemistry 36 (1964); through three it is the central difference). A reader finds it (`nsde_torch.recording.derived`) and
infers the rate from the position alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, final

from nsde_torch.errors import ConfigError
from nsde_torch.options import key
from nsde_torch.recording.faults.fault import Fault

if TYPE_CHECKING:
    import numpy as np

    from nsde_torch.data.raw import RawRun
    from nsde_torch.data.system_info import SystemInfo
    from nsde_torch.recording.log import Detected, LoggedRuns


@final
class DerivedRate(Fault):
    """See the module."""

    name = "derived_rate"
    rank = 55
    option = key(
        0,
        "rows of the position that its rate is made of: 2 is the difference from the row before, an odd number the "
        "slope of a parabola",
        low=0,
        high=101,
    )
    annotation = int
    mixes_times = True

    def check(self, value: Any, system: SystemInfo) -> None:
        """See `Fault.check`."""
        if value and value != 2 and (not value % 2 or value < 3):
            raise ConfigError(f"`{self.name}` must be 2 or an odd number of rows from 3 on; got {value}.")
        if value and (system.quaternion is not None or not system.position_derivatives):
            raise ConfigError(
                f"`{self.name}` is for machines with positions and no quaternion; {system.name!r} is none."
            )

    def simulate(
        self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: np.random.Generator
    ) -> None:
        """See `Fault.simulate`."""
        import numpy as np
        from scipy.signal import savgol_filter

        run.x, names = run.x.copy(), list(system.state_names)
        for position, rate, _ in system.position_derivatives:
            q = run.x[:, names.index(position)]
            made = (
                np.diff(q, prepend=q[0]) / dt if value == 2 else savgol_filter(q, value, 2, deriv=1, delta=dt)
            )
            run.x[:, names.index(rate)] = made

    def describe(self, value: Any, *, dt: float) -> dict[str, Any]:
        """See `Fault.describe`."""
        return {"derived_rate_rows": value}

    def detect(self, log: LoggedRuns) -> Detected | None:
        """See `Fault.detect`. The reader has found it, and the rates are inferred: nothing is left to undo."""
        from nsde_torch.recording.log import Detected

        rates = sorted({name for run in log.runs for name in run.inferred})
        if not rates:
            return None
        made = [f.values for f in log.data.summary.findings if f.kind == self.name]
        told = [f"{v['state']} is {v['how']} of {v['position']}" for v in made if v["state"] in rates]
        told += [f"{name} is not in the log" for name in rates if name not in {v["state"] for v in made}]
        words = f"No sensor measured {' and '.join(rates)} ({', '.join(told)}): inferred from the positions alone."
        why = "known from the reading of the log, and taken into account"
        return Detected(self.name, {}, None, words, short=True, reason=why)
