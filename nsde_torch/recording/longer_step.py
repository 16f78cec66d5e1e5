"""A data set on a longer step than that of its log, after the log was looked at at its own rate.

States are those of the log at the new times, inputs the mean of what acted during a step. What is late by less than a
step cannot be seen in the new rows, nor told from physics: it is taken out before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from nsde_torch.data.findings import Finding
from nsde_torch.data.raw import RawRun
from nsde_torch.data.run import DataSet, Run, fingerprint
from nsde_torch.data.summary import summarise
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.errors import DataError
from nsde_torch.recording import times
from nsde_torch.recording.faults.registry import in_order
from nsde_torch.recording.lateness import Late, by_kind, lateness, surely_late

LATE = 1e-4
"""Chance of calling a sensor late that is on time."""


def is_longer(dt: float | None, own: float) -> bool:
    """Whether a step that was asked for holds several rows of the log."""
    return dt is not None and dt > times.LONGER * own


def late_in(system: SystemInfo, runs: Sequence[Run], clock: float) -> list[Late]:
    """Channels that are surely late against others by the kinematics.

    Args:
        system: Names of the states, without rates that were inferred.
        runs: The runs.
        clock: Physical seconds per logged second.
    """
    return surely_late(lateness(system, runs, clock=clock), runs[0].dt, chance=LATE)


def findings_of(late: Sequence[Late], *, action: str = "reported") -> list[Finding]:
    """What the data summary says of late sensors, by the option that takes them out."""
    out = []
    for key, some in by_kind(late).items():
        how = "late" if key == "sensor_delay" else "late behind a filter"
        which = ", ".join(f"{d.channel} is {1e3 * d.seconds:.3g} ms {how} against {d.other}" for d in some)
        remedy = ", ".join(f"{d.channel}: {d.seconds:.3g}" for d in some)
        message = f"{which}, by the kinematics"
        message += (
            f"; `data.{key}={{{remedy}}}` takes it out" if action == "reported" else " at the log's own rate"
        )
        values = {f"{d.channel}_s": d.seconds for d in some}
        out.append(Finding("late_sensor", "", len(some), message, action, values))
    return out


def on_longer_step(data: DataSet, system: SystemInfo, dt: float, *, late: Sequence[Late] = ()) -> DataSet:
    """The data set on another step.

    Args:
        data: On the step of the log.
        system: The machine.
        dt: The longer step [s].
        late: Channels to move to where they belong first; left where they are if a run is too short for it.

    Raises:
        DataError: no stretch of a run is as long as a step.
    """
    findings, runs = list(data.summary.findings), list(data.runs)
    kinds = {kind: {d.channel: d.seconds for d in some} for kind, some in by_kind(late).items()}
    try:
        for fault in in_order():
            if fault.name in kinds:
                runs = [fault.undo(run, system, kinds[fault.name]) for run in runs]
    except DataError:
        runs = list(data.runs)
    else:
        if late:
            findings = [f for f in findings if f.kind != "late_sensor"] + findings_of(
                late, action="taken out"
            )
    runs = [_resampled(run, system, dt) for run in runs]
    rank, slopes = data.summary.input_rank, data.summary.slopes
    own = {"dt": dt, "clock_scale": data.clock_scale}
    summary = summarise(runs, system, kind=data.kind, slopes=slopes, rank=rank, findings=findings, **own)
    mark = fingerprint(runs, system_name=data.system_name, **own)
    return replace(data, runs=runs, dt=dt, summary=summary, fingerprint=mark)


def _resampled(run: Run, system: SystemInfo, dt: float) -> Run:
    nu = len(system.input_names)
    raw = RawRun(run.name, run.t, run.x, run.u[:, :nu], extra=dict(run.extra), source=run.source)
    long = [(a, b) for a, b in run.segments if run.t[b - 1] - run.t[a] >= dt * (1 - times.JITTER)]
    if not long:
        raise DataError(
            f"{run.source or 'run'} {run.name!r}: no stretch without a gap is as long as the step of {dt:.4g} s. Set "
            "`dt` to a shorter one."
        )
    parts = [times.resample(raw, a, b, dt=dt, quaternion=system.quaternion) for a, b in long]
    whole = times.joined(parts)
    ends = np.cumsum([len(part.t) for part in parts]).tolist()
    u = (
        np.column_stack([whole.u, *(whole.extra[name] for name in system.exogenous)])
        if system.exogenous
        else whole.u
    )
    segments = tuple(zip([0, *ends[:-1]], ends, strict=True))
    return replace(run, t=whole.t, x=whole.x, u=u, extra=whole.extra, segments=segments, unbroken=())
