"""States as they were before a smoother of the recording chain.

    x = S^-1 x_log below f_r,        white noise above,

where f_r is the frequency at which S has fallen to a thousandth, or to what rounding left, or to which smoothers that
fit about as well agree. The noise is as large as the sensor's, and much larger than what moves at f_r: what moves above
it is gone, and must not weigh. Where S fits none of the families (`recording.smoothers`), or only roughly, nothing is
restored; white noise is added from where S begins to fall. Noise is drawn from a fixed seed.

Ends of stretches are left out, where nobody knows how the smoother began and ended. In a closed loop the restored log
still lacks what the controller saw above f_r; the test of the loop says so, and intervals widen by it. They widen too
by how far estimates hang on f_r (`narrowed`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.fft import irfft, rfft, rfftfreq
from numpy.typing import NDArray

from nsde_torch.data import DataSet, Run, SystemInfo
from nsde_torch.recording.faults import remedies
from nsde_torch.recording.smoothers import Smoother
from nsde_torch.sysid.late_smoothers import on_time
from nsde_torch.sysid.smoothed_states import Smoothed, group_spectra, sensors_of, smoothed_states
from nsde_torch.systems import System

Array = NDArray[np.float64]

ABOVE, ADDED = 100.0, 10.0
"""Times the spectrum of the motion at f_r that the noise above it is; and times that of the log where noise is added.
The gain of a spring under a white force errs by 13 % where it is as large, by 3 % at 10 times, by 1 % at 100."""
_FADES = 0.15  # of f_r, over which the restored part gives way to noise
_ENDS = 1.5  # left out at the ends of stretches, over the frequency at which |S| is 0.7
_FEWEST = 50  # rows that must be left of a stretch


def restore_states(
    data: DataSet,
    system: SystemInfo,
    *,
    policy: str = "restore",
    taken_out: Iterable[str] = (),
    seed: int = 0,
) -> DataSet:
    """A data set with the smoothing of its states undone; the data set itself where there is none.

    Args:
        policy: "restore", or "keep" for the data set itself.
        taken_out: Names of the faults that the reader took out; behind one that smooths no smoother can be told.

    Returns:
        The data set, with a finding `state_smoothing` in its summary for each smoother. One that has such a finding is
        returned as it is.
    """
    return restored(data, smoothers(data, system, policy=policy, taken_out=taken_out), seed=seed)


def smoothers(
    data: DataSet, system: SystemInfo, *, policy: str = "restore", taken_out: Iterable[str] = ()
) -> list[Smoothed]:
    """What smoothed the states of a data set, for `restored`; arguments as of `restore_states`."""
    known = remedies()
    smooths = any(known[name].remedy_smooths for name in taken_out if name in known)
    done = any(finding.kind == "state_smoothing" for finding in data.summary.findings)
    if policy == "keep" or smooths or done or not isinstance(system, System):
        return []
    clock = data.clock_scale
    return on_time(smoothed_states(data.runs, system, clock), data.runs, system, clock)


def restored(data: DataSet, found: Sequence[Smoothed], *, seed: int = 0) -> DataSet:
    """A data set as it was before smoothers that were found in it, on its step or a shorter one."""
    if not found:
        return data
    runs = _restored(data.runs, found, data.dt * data.clock_scale, seed)
    return data.changed(runs, [*data.summary.findings, *(one.finding() for one in found)])


def narrowed(runs: Sequence[Run], system: System, clock: float = 1.0, *, seed: int = 1) -> list[Run] | None:
    """Runs that hold half of the band up to which states were restored; None where none were.

    Estimates that hang on how far was restored rest on the smoother being right, or on what inputs know of the rest.
    """
    band = {name: hz for run in runs for name, hz in run.band.items()}
    if not band:
        return None
    dt, rng = runs[0].dt * clock, np.random.default_rng(seed)
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


def _restored(runs: Sequence[Run], found: Sequence[Smoothed], dt: float, seed: int) -> list[Run]:
    rng = np.random.default_rng(seed)
    ends = [_ENDS / one.smoother.falls_to(0.7) for one in found if any(one.restored)]
    out_of_use = int(np.ceil(max(ends, default=0.0) / dt))
    pairs = [pair for one in found for pair in zip(one.sensors, one.reach, strict=True)]
    band = {name: reach for sensor, reach in pairs if reach < 0.5 / dt for name in sensor.names}
    out = []
    for run in runs:
        x = np.array(run.x)
        for a, b in run.segments:
            for one in found:
                _restore_stretch(x[a:b], one, dt, rng)
        inner = [(a + out_of_use, b - out_of_use) for a, b in run.segments]
        kept = tuple((a, b) for a, b in inner if b - a >= _FEWEST)
        out.append(replace(run, x=x, segments=kept or run.segments, band=band))
    return out


def _restore_stretch(x: Array, one: Smoothed, dt: float, rng: np.random.Generator) -> None:
    for sensor, reach, restored, how, seen in zip(
        one.sensors, one.reach, one.restored, one.fits, one.seen, strict=True
    ):
        if not restored and reach >= 0.5 / dt:  # these rows hold nothing of where it falls
            continue
        at = int(np.argmin(np.abs(seen.f - reach)))
        values = sensor.values(x, dt)
        # what moves above is gone: it must not weigh beside the noise that stands in for it
        level = how.noise[:, at] + ABOVE * how.motion[:, at] if restored else ADDED * seen.power[:, at]
        noise = rng.standard_normal(values.shape) * np.sqrt(level / (2.0 * dt))
        new = _unsmoothed(values, one.smoother, reach, noise, dt) if restored else values + noise
        sensor.with_values(x, new, dt)


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
    above = irfft(rfft(noise, axis=0) * np.sqrt(1.0 - np.square(_resampled(keep, n)))[:, None], n, axis=0)
    return np.asarray(before[around : around + n] + above)


def _resampled(values: Array, rows: int) -> Array:
    """Values on the frequencies of a real transform of `rows`."""
    bins = rows // 2 + 1
    return np.asarray(np.interp(np.linspace(0.0, 1.0, bins), np.linspace(0.0, 1.0, len(values)), values))
