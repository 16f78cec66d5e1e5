"""A recording chain: what it does to the runs of a plant, and a log with that undone.

Faults are asked for in the order in which they act; they need no dynamics to show. Some can look like something else,
and are undone only where the declared physics fits better for it: what is half a step late may be how a simulator
steps.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias, final

import numpy as np
from scipy.optimize import minimize_scalar

from nsde_torch.arrays import Array
from nsde_torch.data.kinematics import pairs_of
from nsde_torch.data.raw import RawRun
from nsde_torch.data.run import DataSet, Run
from nsde_torch.data.system_info import SystemInfo, common_name
from nsde_torch.errors import ConfigError
from nsde_torch.options import check
from nsde_torch.recording.fault import NATS, Detected, Fault, LoggedRuns
from nsde_torch.recording.faults import FAULTS, ClockScale, in_order, recording_options
from nsde_torch.recording.latency import on_time, suspected_latency

Misfits: TypeAlias = Callable[[Sequence[Run]], Array]
"""Negative log likelihood per row [nats] of the declared physics in runs, by channel."""
_SENSOR_S, _SENSOR_NATS, _Z90 = 0.2, 20.0, 1.645
"""Longest delay of a sensor as a whole, and how much likelier the log must be, as nothing else shows it."""


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


def instead_of_effects(
    found: Recorded, system: SystemInfo, misfits: Misfits, *, rows: int, other: float
) -> Recorded | None:
    """The log without the delay of one sensor, position and rate alike, against all else; None where there is none.

    Kinematics do not show it, and effects that do the same pay for one channel with another. So it is asked for where
    effects leave structure, has to do better than they, and no channel may pay for it: attitude and rates moved by the
    time that motors lag behind would otherwise take their place. `rows` is the number of rows that `misfits` are per,
    and `other` the misfit of physics with effects, all channels together.
    """
    runs = found.runs
    pairs = [(common_name(positions), common_name(rates)) for positions, rates in pairs_of(system).values()]
    step = runs[0].dt
    longest = min(_SENSOR_S * runs[0].pace / step, 0.1 * min(b - a for run in runs for a, b in run.segments))
    if len(pairs) < 2 or longest < 1.0:  # no sensor is late by as much as a step
        return None
    unmoved = misfits(runs)
    other = min(other, float(unmoved.sum()))

    def moved_by(steps: float, pair: tuple[str, str]) -> list[Run]:
        return [on_time(run, system, dict.fromkeys(pair, steps * step)) for run in runs]

    def misfit(steps: float, pair: tuple[str, str]) -> float:
        return float(misfits(moved_by(steps, pair)).sum())

    best = (np.inf, 0.0, pairs[0])
    for pair in pairs:
        at, here = 1.0, misfit(1.0, pair)
        while 2.0 * at <= longest and (there := misfit(2.0 * at, pair)) < here:
            at, here = 2.0 * at, there
        if here < min(other - NATS / rows, best[0]):
            bounds = (0.5 * at, min(2.0 * at, longest))
            nearer = minimize_scalar(
                misfit, args=(pair,), bounds=bounds, method="bounded", options={"maxiter": 8}
            )
            best = min((here, at, pair), (float(nearer.fun), float(nearer.x), pair))
    here, at, pair = best
    if here > other - _SENSOR_NATS / rows:
        return None
    without = tuple(moved_by(at, pair))
    if (misfits(without) > unmoved + NATS / rows).any():
        return None
    curvature = float(misfits(moved_by(1.5 * at, pair)).sum()) - here
    half = _Z90 * 0.5 * at * step / max(2.0 * rows * curvature, 1e-12) ** 0.5
    if half >= at * step:  # another time would do as well: what it does is no delay's
        return None
    undone = found.values("sensor_delay")
    wholes = {channel: at * step + undone.get(channel, 0.0) for channel in pair}
    values = {channel: (whole, whole - half, whole + half, "s") for channel, whole in wholes.items()}
    words = (
        f"{' and '.join(pair)} are logged {1e3 * at * step:.3g} ms later than all else: the declared physics fits "
        "better so than with any effects."
    )
    late = Detected("sensor_delay", values, None, words)
    return replace(found, runs=without, faults=(*found.faults, late))
