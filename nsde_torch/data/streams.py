"""Streams of a log: columns on one clock, and their values at other times.

States are interpolated between rows, attitudes on the great circle, commands held, as that is what they did. A value is
missing beyond the ends of its stream and in pauses (longer than 0.25 s and than five steps).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from nsde_torch.arrays import Array
from nsde_torch.data.quaternion import continuous_signs, slerp
from nsde_torch.errors import DataError

PAUSE_S = 0.25  # shortest pause [s]
MAX_DISORDER = 0.05  # share of rows out of order that is sorted; more is refused
_SAME = 5e-7  # seconds by which two stamps of one moment may differ: clocks that count from 1970 have no finer numbers
_STEPS = 5.0  # of a stream that are no pause yet
_FASTER = 1.5  # times the rate of the rows from which on commands are averaged over a step


@dataclass
class Stream:
    """Columns on one clock."""

    name: str  # topic, message or group; empty where a file holds one table alone
    t: Array  # times [s], (n,), increasing; nan throughout where the log has no clock
    fields: dict[str, Array]  # columns by name, each (n,)
    units: Mapping[str, str] = field(default_factory=dict)  # unit of a column, where the log says it

    def columns(self, *names: str) -> Array:
        """Fields side by side, (n, columns).

        Raises:
            DataError: one is not there.
        """
        for name in names:
            if name not in self.fields:
                known = ", ".join(list(self.fields)[:8]) or "none"
                raise DataError(f"{self.name or 'the table'!r} has no field {name!r}; it has {known}.")
        return np.stack([self.fields[n] for n in names], axis=1)

    def vector(self, name: str, size: int) -> Array:
        """An array field, (n, size)."""
        return self.columns(*(f"{name}[{k}]" for k in range(size)))

    @property
    def rate(self) -> float:
        """Median rate [Hz]; nan without a clock or of fewer than two rows."""
        if len(self.t) < 2 or not np.isfinite(self.t[0]):
            return float("nan")
        return 1.0 / max(float(np.median(np.diff(self.t))), 1e-12)

    @property
    def timed(self) -> bool:
        """Whether it has a clock."""
        return bool(len(self.t)) and bool(np.isfinite(self.t).all())


def moving(values: Array) -> NDArray[np.bool_]:
    """Columns (n, k) that change, (k,); one without a finite value does not."""
    good = np.isfinite(values)
    low = np.where(good, values, np.inf).min(axis=0, initial=np.inf)
    high = np.where(good, values, -np.inf).max(axis=0, initial=-np.inf)
    return np.asarray(high > low)


def ordered(stream: Stream) -> Stream:
    """A stream in the order of its times, of rows of one time the first."""
    steps = np.diff(stream.t)
    if not stream.timed or (steps > 0).all():
        return stream
    order = np.argsort(stream.t, kind="stable")
    order = order[np.concatenate([[True], np.diff(stream.t[order]) > 0])]
    fields = {name: values[order] for name, values in stream.fields.items()}
    return Stream(stream.name, stream.t[order], fields, stream.units)


def disorder(t: Array, name: str) -> tuple[int, str]:
    """How many rows lie before an earlier one in time, and why that is too many; empty where sorting mends it."""
    late = int((t < np.maximum.accumulate(t)).sum())
    if late <= max(1, MAX_DISORDER * len(t)):
        return late, ""
    first = int(np.flatnonzero(np.diff(t) < 0)[0])
    return late, (
        f"`{name}` goes back from {t[first]:.6g} s to {t[first + 1]:.6g} s and {late} of {len(t)} rows lie before an "
        "earlier row: they are not in the order of time. The clock started again or the rows are shuffled: split the "
        "recording into one file for each run, or sort it by time."
    )


def pause_mask(stream: Stream, t: Array) -> NDArray[np.bool_]:
    """Times that lie outside a stream or in a pause of it."""
    limit = max(PAUSE_S, _STEPS / stream.rate)
    left = np.searchsorted(stream.t, t, side="right") - 1
    outside = (left < 0) | (t > stream.t[-1] + limit)
    left = np.clip(left, 0, len(stream.t) - 2)
    inside = (stream.t[left + 1] - stream.t[left] > limit) & (t > stream.t[left]) & (t < stream.t[left + 1])
    return np.asarray(outside | inside)


def linear(stream: Stream, values: Array, t: Array) -> Array:
    """Columns (n, k) of a stream at other times; missing in its pauses and beyond its ends."""
    out = np.stack([np.interp(t, stream.t, column) for column in values.T], axis=1)
    out[pause_mask(stream, t) | (t > stream.t[-1])] = np.nan
    return out


def held(stream: Stream, values: Array, t: Array) -> Array:
    """The last value at or before each time; missing before the first and in pauses."""
    left = np.searchsorted(stream.t, t + _SAME, side="right") - 1
    out: Array = values[np.clip(left, 0, None)].copy()
    out[pause_mask(stream, t)] = np.nan
    return out


def commands(stream: Stream, values: Array, t: Array) -> Array:
    """What was commanded from each time to the next, (m, k): held, or the mean of a faster stream over the step."""
    out = held(stream, values, t)
    if len(t) < 2 or not stream.rate > _FASTER / float(np.median(np.diff(t))):
        return out
    # the integral of the held command at the edges of the steps
    whole = np.concatenate(
        [np.zeros((1, values.shape[1])), np.cumsum(values[:-1] * np.diff(stream.t)[:, None], axis=0)]
    )
    left = np.clip(np.searchsorted(stream.t, t, side="right") - 1, 0, None)
    integral = whole[left] + values[left] * (t - stream.t[left])[:, None]
    step = np.diff(t)
    mean = np.diff(integral, axis=0) / step[:, None]
    usual = step < 2.5 * float(np.median(step))
    good = usual & np.isfinite(mean).all(axis=1) & np.isfinite(out[:-1]).all(axis=1)
    out[:-1][good] = mean[good]
    return out


def attitudes(stream: Stream, q: Array, t: Array) -> Array:
    """Quaternions (n, 4) at other times, on the great circle between neighbours."""
    q, _ = continuous_signs(q)
    left = np.clip(np.searchsorted(stream.t, t, side="right") - 1, 0, len(stream.t) - 2)
    share = np.clip((t - stream.t[left]) / (stream.t[left + 1] - stream.t[left]), 0.0, 1.0)
    out = slerp(q[left], q[left + 1], share)
    out[pause_mask(stream, t) | (t > stream.t[-1])] = np.nan
    return out
