"""A recording chain: what it does to the runs of a plant, and a log with that undone.

Faults are asked for in the order in which they act; they need no dynamics to show. Some can look like something else,
and are undone only where the declared physics fits better for it: what is half a step late may be how a simulator
steps.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from nsde_torch.data.raw import RawRun
from nsde_torch.data.run import DataSet, Run
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.errors import ConfigError
from nsde_torch.options import check
from nsde_torch.recording.fault import NATS, Detected, Fault, LoggedRuns
from nsde_torch.recording.faults import FAULTS, ClockScale, in_order, recording_options
from nsde_torch.recording.latency import suspected_latency


@final
class Recording:
    """A recording chain with faults, sizes by name (`RecordingOptions` lists them); without any it logs what there is.

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
        return float(self._faults.get(ClockScale.name, 1.0))

    @property
    def mixing_times(self) -> list[str]:
        """The faults that make a row of the log depend on other rows than its own."""
        return [name for name, fault in FAULTS.items() if fault.mixes_times and name in self._faults]

    def check(self, system: SystemInfo) -> None:
        """Refuse what this system cannot have; a ConfigError names the key, what it takes and what it was given."""
        check(recording_options(), self._faults, "recording.")
        for name, value in self._faults.items():
            FAULTS[name].check(value, system)

    def rows_late(self, dt: float) -> int:
        """Rows by which some state is late, at a step `dt` [s] of the log."""
        return sum(fault.rows_before(value, dt) for fault, value in self._acting())

    def apply(self, run: RawRun, system: SystemInfo, *, dt: float, rng: np.random.Generator) -> RawRun:
        """A run as the chain logs it."""
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


@dataclass(frozen=True)
class Recorded:
    """Runs with the recording chain undone."""

    runs: tuple[Run, ...]
    clock: float  # physical seconds per logged second
    faults: tuple[Detected, ...]

    @property
    def stages(self) -> frozenset[str]:
        """Stages that found something (of `fault.STAGES`)."""
        return frozenset(FAULTS[f.name].stage for f in self.faults)

    @property
    def inputs_restored(self) -> bool:
        """Whether the inputs were averaged in the log, and are restored."""
        return bool(self.values("input_smoothing"))

    def values(self, name: str) -> dict[str, float]:
        """What was found of a fault, by the names that `Fault.undo` takes."""
        return {k: v for f in self.faults if f.name == name for k, v in f.plain.items()}

    def after(self, late: Sequence[Detected]) -> "Recorded":
        """The same with columns that had been moved before, by what the chain shows of them and by that."""

        def whole(one: Detected) -> Detected:
            shown = self.values(one.name)

            def sum_of(part: float | None, channel: str) -> float | None:
                return None if part is None else part + shown.get(channel, 0.0)

            values = {
                name: (value + shown.get(name, 0.0), sum_of(low, name), sum_of(high, name), unit)
                for name, (value, low, high, unit) in one.values.items()
            }
            return replace(one, values=values)

        return replace(self, faults=(*self.faults, *map(whole, late)))

    def like(self, run: Run, system: SystemInfo) -> Run:
        """A further run of the same log with the same faults undone."""
        for fault in in_order():
            values = self.values(fault.name)
            run = fault.undo(run, system, values) if values else run
        return run


def undo(
    data: DataSet,
    runs: Sequence[Run],
    system: SystemInfo,
    *,
    alpha: float,
    misfit: Callable[[Sequence[Run], float], float],
) -> Recorded:
    """Find the faults of a recording chain and undo them; arguments are those of `LoggedRuns`."""
    log = LoggedRuns(data, runs, system, alpha=alpha, misfit=misfit)
    found = []
    for fault in in_order():
        seen = fault.detect(log)
        if seen is not None:
            log.take_out(fault, seen)
            found.append(seen)
    for suspect in suspected_latency(log):
        fault, values = FAULTS[suspect.name], suspect.plain
        # what would do as well if it were nothing is the other direction
        back = log.misfit_with(fault, {channel: -seconds for channel, seconds in values.items()})
        if log.misfit_with(fault, values) < back - NATS / sum(len(run) for run in log.runs):
            log.take_out(fault, suspect)
            found.append(suspect)
    return Recorded(tuple(log.runs), log.clock, tuple(found))
