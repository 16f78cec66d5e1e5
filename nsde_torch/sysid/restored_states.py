"""States as they were before a smoother of the recording chain.

    x = S^-1 x_log below f_r,        white noise above,

where f_r is the frequency at which S has fallen to a hundredth, or to what rounding left, or to which smoothers that
fit about as well agree. The noise is as large as the sensor's, and much larger than what moves at f_r: what moves above
it is gone, and must not weigh. Where S fits none of the families (`recording.smoothers`), or only roughly, nothing is
restored; white noise is added from where S begins to fall. Noise is drawn from a fixed seed.

Ends of stretches are left out, where nobody knows how the smoother began and ended. In a closed loop the restored log
still lacks what the controller saw above f_r; the test of the loop says so, and intervals widen by it. They widen too
by how far estimates hang on f_r (`narrowed`).

A step of 20 ms hides what a log at 1 kHz shows: a rate that is 3 ms late, a filter at 100 Hz. So streams, sensors and
smoothers are looked for in the rows as they were logged (`undone_at_own_rate`). States are restored on the longer step,
where the noise that stands in for what a smoother took has no place above half its rate.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.fft import irfft, rfft, rfftfreq
from numpy.typing import NDArray

from nsde_torch.data import DataSet, Run, SystemInfo
from nsde_torch.recording.faults import remedies
from nsde_torch.recording.latency import late_channels, surely_late
from nsde_torch.recording.smoothers import Smoother
from nsde_torch.recording.stream_offsets import on_one_clock
from nsde_torch.recording.times import is_longer, on_longer_step
from nsde_torch.recording.unmeasured_rates import measured_part
from nsde_torch.sysid.smoothed_states import (
    Smoothed,
    SmoothedSensor,
    group_spectra,
    sensors_of,
    smoothed_states,
)
from nsde_torch.systems import System

Array = NDArray[np.float64]

ABOVE, ADDED = 100.0, 10.0
"""Times the spectrum of the motion at f_r that the noise above it is; and times that of the log where noise is added.
The gain of a spring under a white force errs by 13 % where it is as large, by 3 % at 10 times, by 1 % at 100."""
_FADES = 0.15  # of f_r, over which the restored part gives way to noise
_ENDS = 1.5  # left out at the ends of stretches, over the frequency at which |S| is 0.7
_FEWEST = 50  # rows that must be left of a stretch


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
    found = [] if state_smoothing == "keep" else smoothers(data, system, taken_out)
    if dt is None or not is_longer(dt, data.dt):
        return restored(data, found)
    seen = measured_part(system, {name for run in data.runs for name in run.inferred})
    rows = restored(data, found).runs
    late = [] if stream_offsets == "keep" else late_channels(seen, rows, clock=data.clock_scale)
    late = surely_late(late, rows[0].dt) if late else []
    return restored(on_longer_step(data, system, dt, late=late), found)


def smoothers(data: DataSet, system: SystemInfo, taken_out: Iterable[str] = ()) -> list[Smoothed]:
    """What smoothed the states of a data set, for `restored`; nothing of columns without physics, or once it is undone.

    Behind a fault that the reader took out (`taken_out`) and that smooths no smoother can be told.
    """
    known = remedies()
    smooths = any(known[name].remedy_smooths for name in taken_out if name in known)
    done = any(finding.kind == "state_smoothing" for finding in data.summary.findings)
    if smooths or done or not isinstance(system, System):
        return []
    return smoothed_states(data.runs, system, data.clock_scale)


def restored(data: DataSet, found: Sequence[Smoothed]) -> DataSet:
    """A data set as it was before smoothers that were found in it, on its step or a shorter one.

    Its summary has a finding `state_smoothing` for each smoother.
    """
    if not found:
        return data
    runs = _restored(data.runs, found, data.dt * data.clock_scale)
    return data.changed(runs, [*data.summary.findings, *(one.finding() for one in found)])


def narrowed(runs: Sequence[Run], system: System, clock: float = 1.0) -> list[Run] | None:
    """Runs that hold half of the band up to which states were restored; None where none were.

    Estimates that hang on how far was restored rest on the smoother being right, or on what inputs know of the rest.
    """
    band = {name: hz for run in runs for name, hz in run.band.items()}
    if not band:
        return None
    dt, rng = runs[0].dt * clock, np.random.default_rng(1)
    states = [np.array(run.x) for run in runs]
    for sensor in sensors_of(system):
        reach = 0.5 * min((band[name] for name in sensor.names if name in band), default=0.0)
        seen = group_spectra(sensor, runs, dt) if reach else None
        if seen is None:
            continue
        level = ADDED * seen.power[:, int(np.argmin(np.abs(seen.f - reach)))]
        for run, x in zip(runs, states, strict=True):
            for a, b in run.segments:
                values = sensor.values(x[a:b], dt)
                noise = rng.standard_normal(values.shape) * np.sqrt(level / (2.0 * dt))
                sensor.with_values(x[a:b], _unsmoothed(values, None, reach, noise, dt), dt)
    return [replace(run, x=x) for run, x in zip(runs, states, strict=True)]


def _restored(runs: Sequence[Run], found: Sequence[Smoothed], dt: float) -> list[Run]:
    rng = np.random.default_rng(0)
    pairs = [(one.smoother, k) for one in found for k in one.behind]
    ends = [_ENDS / smoother.falls_to(0.7) for smoother, k in pairs if k.restored]
    out_of_use = int(np.ceil(max(ends, default=0.0) / dt))
    held = [k for _, k in pairs if k.reach < 0.5 / dt]  # else these rows hold nothing of where it falls
    band = {name: k.reach for k in held for name in k.sensor.names}
    low_pass = {name: k.reach for k in held if _louder_above(k) for name in k.sensor.names}
    out = []
    for run in runs:
        x = np.array(run.x)
        for a, b in run.segments:
            for smoother, k in pairs:
                if k.restored or k.reach < 0.5 / dt:
                    _restore_stretch(x[a:b], smoother, k, dt, rng)
        inner = [(a + out_of_use, b - out_of_use) for a, b in run.segments]
        kept = tuple((a, b) for a, b in inner if b - a >= _FEWEST)
        whole = run.unbroken or run.segments
        segments = kept or run.segments
        out.append(replace(run, x=x, segments=segments, band=band, low_pass=low_pass, unbroken=whole))
    return out


def _louder_above(one: SmoothedSensor) -> bool:
    """Whether the noise that stands above the band of a sensor is surely louder than its own below."""
    at = int(np.argmin(np.abs(one.seen.f - one.reach)))
    return not one.restored or bool((ABOVE * one.fit.motion[:, at] > one.fit.noise[:, at]).any())


def _restore_stretch(
    x: Array, smoother: Smoother, one: SmoothedSensor, dt: float, rng: np.random.Generator
) -> None:
    at = int(np.argmin(np.abs(one.seen.f - one.reach)))
    values = one.sensor.values(x, dt)
    # what moves above is gone: it must not weigh beside the noise that stands in for it
    level = (
        one.fit.noise[:, at] + ABOVE * one.fit.motion[:, at]
        if one.restored
        else ADDED * one.seen.power[:, at]
    )
    noise = rng.standard_normal(values.shape) * np.sqrt(level / (2.0 * dt))
    new = _unsmoothed(values, smoother, one.reach, noise, dt) if one.restored else values + noise
    one.sensor.with_values(x, new, dt)


def _unsmoothed(values: Array, smoother: Smoother | None, reach: float, noise: Array, dt: float) -> Array:
    """Values (n, C) of one stretch before a smoother up to a frequency, and noise above it."""
    n = len(values)
    around = min(n - 1, int(3.0 / (_FADES * reach * dt)) + _FEWEST)
    first, last = 2.0 * values[0] - values[around:0:-1], 2.0 * values[-1] - values[-2 : -around - 2 : -1]
    longer = np.concatenate([first, values, last])
    line = np.linspace(longer[0], longer[-1], len(longer))
    f = rfftfreq(len(longer), dt)
    keep = 0.5 * (1.0 + np.cos(np.pi * np.clip((f - reach) / (_FADES * reach) + 1.0, 0.0, 1.0)))
    response = np.ones_like(f) if smoother is None else np.where(keep > 0, smoother.response(f), 1.0)
    gain = np.where(keep > 0, keep / response, 0.0)
    before = irfft(rfft(longer - line, axis=0) * gain[:, None], len(longer), axis=0) + line
    there = np.interp(np.linspace(0.0, 1.0, n // 2 + 1), np.linspace(0.0, 1.0, len(keep)), keep)
    above = irfft(rfft(noise, axis=0) * np.sqrt(1.0 - np.square(there))[:, None], n, axis=0)
    return np.asarray(before[around : around + n] + above)
