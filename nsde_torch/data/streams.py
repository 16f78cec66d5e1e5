"""Streams of a log: columns on one clock, their values at other times, and one file of a log as streams.

States are interpolated between rows, attitudes on the great circle, commands held, as that is what they did. A value is
missing beyond the ends of its stream and in pauses (longer than 0.25 s and than five steps).
"""

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nsde_torch.arrays import Array
from nsde_torch.data.quaternion import continuous_signs, slerp
from nsde_torch.errors import ConfigError, DataError, NsdeError
from nsde_torch.lookup import did_you_mean

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
        """Fields side by side, (n, columns); DataError where one is not there."""
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


_HELD = 1 / 3
"""Share of rows that must repeat a time with other values before the clock is taken to be coarser than the rows."""
_OFF_TICKS = 1.2
"""Ticks of a coarse clock within which rows at one step lie about their times: rounding alone makes it one."""


def unrounded(t: Array, values: Array) -> Array | None:
    """Increasing times of rows (n, k) that came at one step, and faster than their clock `t` ticks; None of others.

    Keeping the first row of each time would lose what the inputs did in between.
    """
    both = np.isfinite(values[1:]) & np.isfinite(values[:-1])
    changed = ((values[1:] != values[:-1]) & both).any(axis=1) & (np.diff(t) == 0)
    if changed.sum() <= _HELD * len(t) or (np.diff(t) < 0).any():
        return None
    first = np.flatnonzero(np.diff(t, prepend=-np.inf))
    ticks = np.diff(t[first])
    if len(ticks) < 2:
        return None
    tick = float(np.median(ticks))
    edges = [0, *first[1:][ticks > 1.5 * tick].tolist(), len(t)]  # between pauses
    stretches = list(itertools.pairwise(edges))
    a, b = max(stretches, key=lambda ends: ends[1] - ends[0])
    step = float(np.polyfit(np.arange(b - a), t[a:b] - t[a], 1)[0])
    out = np.concatenate([t[a:b].mean() + step * (np.arange(b - a) - (b - a - 1) / 2) for a, b in stretches])
    if step <= 0 or max(np.ptp(out[a:b] - t[a:b]) for a, b in stretches) > _OFF_TICKS * tick:
        return None
    return out if (np.diff(out) > 0).all() else None


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


# One file of a log: how its tables give the time, and what its format says of the meaning of columns.

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
UNNAMED = "column_"  # what the name of a column begins with that has its number alone, from 1
_NAMES = re.compile(r"(t|tout|time|times|timestamp|stamp|time_?stamp|secs?|seconds|elapsed|clock|tick)")
_UNIT = re.compile(r"[\[\(_ ]\s*(s|sec|seconds|ms|msec|us|usec|µs|ns|nsec)\s*[\]\)]?$")
_SPELT = {"sec": "s", "seconds": "s", "msec": "ms", "usec": "us", "µs": "us", "nsec": "ns"}


@dataclass(frozen=True)
class ClockOf:
    """How a table gives the time."""

    source: str | None = None  # column; None: the one whose name says so
    unit: str | None = None  # of the column, a key of `SECONDS`; None: by the size of its steps
    rate: float | None = None  # rows a second, of a table without a clock [Hz]


_DATE = re.compile(
    r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d(?::\d\d(?:[.,]\d{1,9})?)?) ?(?:(Z)|([+-]\d\d):?(\d\d)?)?"
)


def from_date(text: str) -> float | None:
    """Seconds since 1970 of a date with a time of day, as ISO 8601 and pandas write it; None of anything else."""
    said = _DATE.fullmatch(text.strip())
    if said is None:
        return None
    try:
        seconds = float(np.datetime64(f"{said[1]}T{said[2].replace(',', '.')}", "ns").astype(np.int64)) * 1e-9
    except ValueError:
        return None
    east = 0.0 if said[4] is None else float(said[4]) * 60.0 + float(f"{said[4][0]}{said[5] or 0}")
    return seconds - 60.0 * east


def time_column(names: Mapping[str, object] | list[str]) -> str | None:
    """The column whose name says that it is the time; None where none does."""
    for name in names:
        bare = _UNIT.sub("", name.strip().lower().replace("#", "").strip()).strip()
        if _NAMES.fullmatch(re.split(r"[./]", bare)[-1]):
            return name
    return None


def unit_of(name: str, values: Array) -> str:
    """Unit of a time column: as its name says, else the one in which its steps are 10 us to 1 s."""
    said = _UNIT.search(name.strip().lower())
    if said:
        return _SPELT.get(said[1], said[1])
    steps = np.diff(np.sort(values[np.isfinite(values)]))
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    if step < 1.0:
        return "s"
    return "ms" if step < 1e3 else "us" if step < 1e6 else "ns"


def found(fields: Mapping[str, Array], clock: ClockOf) -> ClockOf | None:
    """The clock of a table with what was left open filled in; None where there is none."""
    if clock.rate is not None:
        return clock
    said = (clock.source.split("/")[-1], clock.source) if clock.source else ()
    column = next((name for name in said if name in fields), None) or time_column(list(fields))
    if column is None:  # of a table without names, times are what is usually in front and increases
        first = [name for name in fields if name == f"{UNNAMED}1" or name.endswith("[0]")]
        column = next((name for name in first if _ticks(name, fields[name])), None)
    return None if column is None else ClockOf(column, clock.unit or unit_of(column, fields[column]))


def _ticks(name: str, values: Array) -> bool:
    """Whether a column without a name is a clock: it increases, and in even steps where it is one of an array."""
    steps = np.diff(values)
    even = name.startswith(UNNAMED) or bool(np.ptp(steps) < 0.1 * np.median(steps))
    return bool((steps > 0).all()) and even


def timed(name: str, fields: dict[str, Array], clock: ClockOf, notes: list[str], *, source: str) -> Stream:
    """A table with its clock taken out of its columns, all of one length; a DataError where it is no clock.

    `notes` takes what was assumed of the times.
    """
    rows = len(next(iter(fields.values())))
    if clock.rate is not None:
        return Stream(name, np.arange(rows) / clock.rate, fields)
    own = found(fields, clock)
    if own is None or own.source is None:
        return Stream(name, np.full(rows, np.nan), fields)
    column, values = own.source, fields[own.source]
    good = np.isfinite(values)
    if good.sum() < 2 or not np.diff(values[good]).any():
        raise DataError(
            f"{source}: the column {column!r} is taken for the time and does not increase; a run needs two rows. "
            "Record longer, or say in a mapping which column it is, `time: {from: NAME, unit: s}`."
        )
    times = values[good] * SECONDS[own.unit or "s"]
    _, shuffled = disorder(times, column)
    if shuffled:
        raise DataError(f"{source}: {shuffled}")
    kept = {key: v[good] for key, v in fields.items() if key != column}
    even = unrounded(times, np.stack(list(kept.values()), axis=1)) if kept else None
    if even is not None:
        said = f"{len(times)} rows have {len(np.unique(times))} times"
        notes.append(f"{said} in {column!r}: they are taken to be {np.diff(even)[0] * 1e3:.4g} ms apart")
        times = even
    return ordered(Stream(name, times, kept))


@dataclass
class StreamLog:
    """What is in a file."""

    name: str  # of the run
    source: str  # file, for messages
    streams: Sequence[Stream]  # columns on their clocks
    columns: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    """By what is meant (`p`, `v`, `q`, `w`, `u`, a channel): how the format itself says that it is logged, as an entry
    of a mapping would."""
    frames: Mapping[str, str] = field(default_factory=dict)
    """Axes that the format fixes: `world` (ENU or NED), `body` (FLU or FRD)."""
    notes: Sequence[str] = ()  # what the reader found, in words
    clock: ClockOf | None = None  # how the time was read from a table; None: the format says it

    def names(self) -> list[str]:
        """Every column, `stream/column`; of a stream without a name the column alone."""
        return [full(s, column) for s in self.streams for column in s.fields]

    def stream(self, name: str) -> Stream:
        """The stream of that name."""
        return next(stream for stream in self.streams if stream.name == name)

    def has(self, name: str) -> bool:
        """Whether there is a column of that name."""
        return any(name in (full(s, c), c) for s in self.streams for c in s.fields)

    def find(self, name: str) -> tuple[Stream, str]:
        """The stream and the column of a name, with its stream in front or, where that is enough, without.

        A ConfigError where there is no such column (it names the nearest), or several.
        """
        found = [(s, c) for s in self.streams for c in s.fields if full(s, c) == name]
        found = found or [(s, c) for s in self.streams for c in s.fields if c == name]
        if len(found) == 1:
            return found[0]
        if found:
            where = ", ".join(full(s, c) for s, c in found)
            raise ConfigError(f"the mapping reads {name!r}, which {self.source} has more than once: {where}.")
        known = self.names()
        shown = ", ".join(known[:12]) + (", ..." if len(known) > 12 else "")
        raise ConfigError(
            f"the mapping reads {name!r}, which {self.source} does not have.{did_you_mean(name, known)} It has {shown}."
        )


def full(stream: Stream, column: str) -> str:
    """Name of a column with that of its stream."""
    return f"{stream.name}/{column}" if stream.name else column


def optional(module: str, extra: str, path: Path) -> Any:
    """A module of an optional package, which a file needs; a ConfigError where it is not installed."""
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise ConfigError(
            f"{path.name} needs the package {package!r}, which is not installed: pip install 'nsde_torch[{extra}]'."
        ) from error


@contextmanager
def parsing(path: Path, what: str) -> Iterator[None]:
    """What a parser says of a damaged file, which makes it raise nearly anything, as one error."""
    try:
        yield
    except NsdeError:
        raise
    except Exception as error:
        raise unreadable(path, what, error) from error


def unreadable(path: Path, what: str, error: Exception | str) -> DataError:
    """The error for a file that its parser refuses."""
    reason = error if isinstance(error, str) else f"{type(error).__name__}: {error}"
    return DataError(
        f"{path} is not a readable {what} ({' '.join(reason.split())[:200]}). It may be cut short or of another "
        "format: copy it again, unpack an archive, or save a table as CSV in UTF-8."
    )
