"""Smoothers against the clock: what a causal one makes late, kinematics must show.

An estimator integrates body rates to an attitude. Its error is an integral too, which falls with the frequency as
behind a filter of first order; restored, it would put an attitude that was on time 13 ms before its rates (seen in logs
of a real PX4 at 250 Hz: filters of 40 Hz on the rates, which was so, and of 12 Hz on the attitude, which was not). With

    d(S) = - d arg S / d(2 pi f) at f = 0

the lateness of positions against rates must be d(S_positions) - d(S_rates). Where it is not, and is without one of the
two, that one is no smoother.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import pi

import numpy as np

from nsde_torch.data import Run
from nsde_torch.data.system_info import channel_columns
from nsde_torch.recording.latency import Latency, latencies
from nsde_torch.recording.smoothers import Smoother
from nsde_torch.sysid.smoothed_states import Smoothed
from nsde_torch.systems import System

_SLOW = 1e-3  # of the rate of the log, at which a delay is read off the phase
_NEAR, _FAR = 0.5, 1.0
"""Steps of the log by which a lateness may miss what smoothers make, and by which it must to speak against one."""


def delay(smoother: Smoother) -> float:
    """How late a smoother makes slow motions [s]; 0 for one that is not causal."""
    f = _SLOW / smoother.dt
    return float(-np.angle(smoother.response(np.array([f])))[0] / (2.0 * pi * f))


def on_time(found: Sequence[Smoothed], runs: Sequence[Run], system: System, clock: float) -> list[Smoothed]:
    """Smoothers without those that kinematics contradicts."""
    if not any(delay(one.smoother) for one in found):
        return list(found)
    out = list(found)
    dt = runs[0].dt * clock
    for lag in latencies(system, runs, clock=clock):
        wrong = _contradicted(lag, out, system, dt, clock)
        if wrong:
            out = [left for one in out if (left := _without(one, wrong)) is not None]
    return out


def _contradicted(
    lag: Latency, found: Sequence[Smoothed], system: System, dt: float, clock: float
) -> tuple[int, ...]:
    """Columns of the sensor whose smoother does not fit the lateness; none where all do, or nothing tells which."""
    pair = [tuple(channel_columns(system, name)) for name in (lag.channel, lag.other)]
    late = [_delay_of(columns, found) for columns in pair]
    if late[0] is None or late[1] is None:
        return ()
    seen = lag.seconds * clock

    def off(position: float, rate: float) -> float:
        return abs(seen - (position - rate)) / dt

    if off(late[0], late[1]) < _FAR:
        return ()
    without = [off(0.0, late[1]), off(late[0], 0.0)]
    best = int(np.argmin(without))
    return pair[best] if without[best] < _NEAR <= without[1 - best] else ()


def _delay_of(columns: tuple[int, ...], found: Sequence[Smoothed]) -> float | None:
    for one in found:
        if any(set(sensor.columns) == set(columns) for sensor in one.sensors):
            return delay(one.smoother)
    return None


def _without(one: Smoothed, columns: tuple[int, ...]) -> Smoothed | None:
    """Sensors behind a smoother but for one; None where none is left."""
    kept = [k for k, sensor in enumerate(one.sensors) if set(sensor.columns) != set(columns)]
    if len(kept) == len(one.sensors):
        return one
    if not kept:
        return None
    return replace(
        one,
        sensors=tuple(one.sensors[k] for k in kept),
        reach=tuple(one.reach[k] for k in kept),
        restored=tuple(one.restored[k] for k in kept),
        fits=tuple(one.fits[k] for k in kept),
        seen=tuple(one.seen[k] for k in kept),
    )
