"""A turned frame: q_log = q (1, r / 2), omega_log = R(r)^T omega, for the rotation r from body to the log's frame.

No kinematics show it: attitude and rates are turned alike. In a log it is an effect, which a diagnosis looks for as it
does for the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import pi
from typing import TYPE_CHECKING, Any, final

from nsde_torch.errors import ConfigError
from nsde_torch.options import key
from nsde_torch.recording.faults.fault import Fault

if TYPE_CHECKING:
    import numpy as np

    from nsde_torch.data.raw import RawRun
    from nsde_torch.data.system_info import SystemInfo


@final
class TurnedFrame(Fault):
    """See the module."""

    name = "frame_misalignment"
    rank = 70
    option = key(
        (0.0, 0.0, 0.0), "turn of the log's body frame against the machine's about x, y, z", unit="deg"
    )
    annotation = Sequence[float]

    def check(self, value: Any, system: SystemInfo) -> None:
        """See `Fault.check`."""
        if len(value) != 3:
            raise ConfigError(f"`frame_misalignment` takes three angles [deg]; got {list(value)}.")
        if system.quaternion is None and any(value):
            raise ConfigError(
                f"`frame_misalignment` needs an attitude, which system {system.name!r} has not. Use `sensor_bias`."
            )

    def simulate(
        self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: np.random.Generator
    ) -> None:
        """See `Fault.simulate`."""
        import numpy as np
        import torch

        from nsde_torch.data.system_info import rate_columns
        from nsde_torch.rotation import rotate_back, turned

        assert system.quaternion is not None
        x = run.x.copy()
        q = torch.from_numpy(x[:, system.quaternion])
        angle = torch.from_numpy(np.asarray(value) * (pi / 180.0)).expand(len(x), 3)
        identity = torch.zeros_like(q)
        identity[:, 0] = 1.0
        x[:, system.quaternion] = turned(q, angle).numpy()
        rates = rate_columns(system)
        if rates is not None:
            x[:, rates] = rotate_back(turned(identity, angle), torch.from_numpy(x[:, rates].copy())).numpy()
        run.x = x

    def describe(self, value: Any, *, dt: float) -> dict[str, Any]:
        """See `Fault.describe`."""
        return {"frame_misalignment_deg": [float(v) for v in value]}
