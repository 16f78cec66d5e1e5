"""What a recording chain does to the runs of a plant before they are written."""

from __future__ import annotations

from typing import Any, final

import numpy as np

from nsde_torch.data.raw import RawRun
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.errors import ConfigError
from nsde_torch.options import check
from nsde_torch.recording.faults.fault import Fault
from nsde_torch.recording.faults.registry import FAULTS, in_order
from nsde_torch.recording.options import recording_options


@final
class Recording:
    """A recording chain with faults; without any it logs what there is.

    Args:
        faults: Sizes by name of the fault (`RecordingOptions` lists them).

    Raises:
        ConfigError: no fault of that name.

    Example:
        >>> Recording(sensor_bias={"q_dot": 0.1}, dropout=0.02).as_dict(0.01)
        {'sensor_bias': {'q_dot': 0.1}, 'dropout': 0.02}
    """

    def __init__(self, **faults: Any) -> None:
        unknown = sorted(set(faults) - set(FAULTS))
        if unknown:
            raise ConfigError(f"a recording has no fault {unknown[0]!r}; faults: {', '.join(FAULTS)}.")
        self._faults = {name: value for name, value in faults.items() if FAULTS[name].present(value)}

    def __repr__(self) -> str:
        return f"Recording({', '.join(f'{name}={value!r}' for name, value in self._faults.items())})"

    @property
    def clock(self) -> float:
        """Physical seconds for each logged second."""
        return float(np.prod([fault.clock(value) for fault, value in self._acting()]))

    @property
    def mixing_times(self) -> list[str]:
        """The faults that make a row of the log depend on other rows than its own."""
        return [name for name, fault in FAULTS.items() if fault.mixes_times and name in self._faults]

    def check(self, system: SystemInfo) -> None:
        """Refuse what this system cannot have.

        Raises:
            ConfigError: names the key, what it takes and what it was given.
        """
        check(recording_options(), self._faults, "recording.")
        for name, value in self._faults.items():
            FAULTS[name].check(value, system)

    def rows_late(self, dt: float) -> int:
        """Rows by which some state is late, at a step `dt` [s] of the log."""
        return sum(fault.rows_before(value, dt) for fault, value in self._acting())

    def apply(self, run: RawRun, system: SystemInfo, *, dt: float, rng: np.random.Generator) -> RawRun:
        """A run as the chain logs it.

        Args:
            run: As the plant made it, `rows_late` rows longer than what is wanted.
            system: The machine.
            dt: Step of the log [s].
            rng: Source of the missing rows.
        """
        made = RawRun(run.name, run.t, run.x, run.u, extra=run.extra, source=run.source)
        for fault, value in self._acting():
            if fault.mixes_times:
                fault.simulate(made, value, system, dt=dt, rng=rng)
        made.rows(slice(self.rows_late(dt), None))
        made.t = dt * np.arange(len(made.t), dtype=np.float64)
        for fault, value in self._acting():
            if not fault.mixes_times:
                fault.simulate(made, value, system, dt=dt, rng=rng)
        return made

    def as_dict(self, dt: float) -> dict[str, Any]:
        """The faults as they were applied, with units in the keys; only those that there are."""
        out: dict[str, Any] = {}
        for name, fault in FAULTS.items():
            if name in self._faults:
                out |= fault.describe(self._faults[name], dt=dt)
        return out

    def _acting(self) -> list[tuple[Fault, Any]]:
        return [(fault, self._faults[fault.name]) for fault in in_order() if fault.name in self._faults]
