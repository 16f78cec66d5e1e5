"""Streams, sensors and smoothers of a log, looked for at its own rate; then the step that was asked for.

A step of 20 ms hides what a log at 1 kHz shows: a rate that is 3 ms late, a filter at 100 Hz. So all of that is found
in the rows as they were logged. States are restored on the longer step, where the noise that stands in for what a
smoother took has no place above half its rate.
"""

from __future__ import annotations

from collections.abc import Iterable

from nsde_torch.data import DataSet, SystemInfo
from nsde_torch.recording.latency import late_channels, surely_late
from nsde_torch.recording.stream_offsets import on_one_clock
from nsde_torch.recording.times import is_longer, on_longer_step
from nsde_torch.recording.unmeasured_rates import measured_part
from nsde_torch.sysid.restored_states import restored, smoothers


def undone_at_own_rate(
    data: DataSet,
    system: SystemInfo,
    *,
    dt: float | None,
    stream_offsets: str,
    state_smoothing: str,
    taken_out: Iterable[str] = (),
) -> DataSet:
    """A data set on the step that was asked for, without what the recording did to its states.

    Args:
        dt: The step that was asked for [s]; None: that of the data.
        stream_offsets: "undo", or "keep" streams, and sensors that a longer step would hide, where they are.
        state_smoothing: "restore", or "keep" states as they are.
        taken_out: Names of the faults that the reader took out.
    """
    data = on_one_clock(data, system, policy=stream_offsets)
    found = smoothers(data, system, policy=state_smoothing, taken_out=taken_out)
    if dt is None or not is_longer(dt, data.dt):
        return restored(data, found)
    seen = measured_part(system, {name for run in data.runs for name in run.inferred})
    rows = restored(data, found).runs
    late = [] if stream_offsets == "keep" else late_channels(seen, rows, clock=data.clock_scale)
    late = surely_late(late, rows[0].dt) if late else []
    return restored(on_longer_step(data, system, dt, late=late), found)
