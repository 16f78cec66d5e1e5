"""Dropped rows. The checks of a reader find the gaps that they leave (`nsde_torch.recording.times`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, final

from nsde_torch.options import key
from nsde_torch.recording.faults.fault import Fault

if TYPE_CHECKING:
    import numpy as np

    from nsde_torch.data.raw import RawRun
    from nsde_torch.data.system_info import SystemInfo


@final
class Dropout(Fault):
    """See the module; the first row and the last stay."""

    name = "dropout"
    rank = 80
    option = key(0.0, "share of the rows that is missing", low=0, high=0.5)

    def simulate(
        self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: np.random.Generator
    ) -> None:
        """See `Fault.simulate`."""
        keep = rng.random(len(run.t)) >= value
        keep[[0, -1]] = True
        run.rows(keep)

    def describe(self, value: Any, *, dt: float) -> dict[str, Any]:
        """See `Fault.describe`."""
        return {self.name: value}
