"""Inputs that are logged as speeds of rotors, u_log = n_max sqrt(u), where shares of thrust are due.

What takes it out is (u_log / n_max)^2, without the glitches of the line (`nsde_torch.recording.rotor_speeds`).
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import TYPE_CHECKING, Any, final

from nsde_torch.options import key
from nsde_torch.recording.faults.fault import Fault

if TYPE_CHECKING:
    import numpy as np

    from nsde_torch.data.raw import RawRun
    from nsde_torch.data.system_info import SystemInfo


@final
class RotorSpeed(Fault):
    """See the module."""

    name = "rotor_speed"
    rank = 90
    option = key(0.0, "log speeds of rotors for commands: the speed of full thrust, 0 for commands", low=0)
    remedy = key(
        {}, "inputs are speeds of rotors: that of full thrust, {u_1: 22000}, or {u: 22000} for u_1 ... u_4"
    )
    remedy_first = True

    def simulate(
        self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: np.random.Generator
    ) -> None:
        """See `Fault.simulate`."""
        import numpy as np

        run.u = float(value) * np.sqrt(np.clip(run.u, 0.0, None))

    def describe(self, value: Any, *, dt: float) -> dict[str, Any]:
        """See `Fault.describe`."""
        return {"rotor_speed_of_full_thrust": float(value)}

    def undo_raw(self, run: RawRun, system: SystemInfo, values: Mapping[str, float]) -> None:
        """See `Fault.undo_raw`: values by name of an input, or by the common name of several."""
        from nsde_torch.data.findings import Finding
        from nsde_torch.errors import ConfigError
        from nsde_torch.recording.rotor_speeds import shares

        names = list(system.input_names)
        u = run.u.copy()
        for channel, most in values.items():
            columns = [k for k, name in enumerate(names) if name == channel or name.startswith(channel + "_")]
            if not columns:
                raise ConfigError(
                    f"`rotor_speed`: {channel!r} is no input of system {system.name!r}; inputs: {', '.join(names)}."
                )
            if (
                isinstance(most, bool)
                or not isinstance(most, int | float)
                or not (isfinite(most) and most > 0)
            ):
                raise ConfigError(f"`rotor_speed.{channel}` must be a speed above 0; got {most!r}.")
            for k in columns:
                where = f"{run.source or 'run'} {run.name!r}"
                u[:, k], rows = shares(run.u[:, k], float(most), name=names[k], where=where)
                if rows:
                    told = f"{len(rows)} rows of rotor speed {names[k]!r} that no rotor can have had"
                    values_ = {"column": names[k], "rows": rows}
                    run.notes.append(
                        Finding("input_glitch", run.name, len(rows), told, "interpolated", values_)
                    )
        run.u = u
