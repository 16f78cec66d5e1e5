"""One file of a log: streams, and what the format says of their meaning."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.streams import Stream, disorder, ordered
from nsde_torch.errors import ConfigError, DataError, NsdeError

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
UNNAMED = "column_"
"""What the name of a column begins with that has its number alone, from 1."""
_NAMES = re.compile(r"(t|tout|time|times|timestamp|stamp|time_?stamp|secs?|seconds|elapsed|clock|tick)")
_UNIT = re.compile(r"[\[\(_ ]\s*(s|sec|seconds|ms|msec|us|usec|µs|ns|nsec)\s*[\]\)]?$")
_SAME = {"sec": "s", "seconds": "s", "msec": "ms", "usec": "us", "µs": "us", "nsec": "ns"}


@dataclass(frozen=True)
class ClockOf:
    """How a table gives the time."""

    source: str | None = None  # column; None: the one whose name says so
    unit: str | None = None  # of the column, a key of `SECONDS`; None: by the size of its steps
    rate: float | None = None  # rows a second, of a table without a clock [Hz]


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
        return _SAME.get(said[1], said[1])
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


def timed(name: str, fields: dict[str, Array], clock: ClockOf, *, source: str) -> Stream:
    """A table with its clock taken out of its columns, all of one length; a DataError where it is no clock."""
    rows = len(next(iter(fields.values())))
    if clock.rate is not None:
        return Stream(name, np.arange(rows) / clock.rate, fields)
    own = found(fields, clock)
    if own is None or own.source is None:
        return Stream(name, np.full(rows, np.nan), fields)
    column, unit = own.source, own.unit
    values = fields[column]
    if unit not in SECONDS:
        raise ConfigError(f"`unit` of the time must be one of {', '.join(SECONDS)}; got {unit!r}.")
    good = np.isfinite(values)
    if good.sum() < 2 or not np.diff(values[good]).any():
        raise DataError(
            f"{source}: the column {column!r} is taken for the time and does not increase; a run needs two rows. "
            "Record longer, or say in a mapping which column it is, `time: {from: NAME, unit: s}`."
        )
    times = values[good] * SECONDS[unit]
    _, shuffled = disorder(times, column)
    if shuffled:
        raise DataError(f"{source}: {shuffled}")
    kept = {key: v[good] for key, v in fields.items() if key != column}
    return ordered(Stream(name, times, kept))


@dataclass
class StreamLog:
    """What is in a file.

    Args:
        name: Of the run.
        source: File, for messages.
        streams: Columns on their clocks.
        columns: By what is meant (`p`, `v`, `q`, `w`, `u`, a channel): how the format itself says that it is logged, as
            an entry of a mapping would.
        frames: Axes that the format fixes: `world` (ENU or NED), `body` (FLU or FRD).
        notes: What the reader found, in words.
        clock: How the time was read from a table; None: the format says it.
    """

    name: str
    source: str
    streams: Sequence[Stream]
    columns: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    frames: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()
    clock: ClockOf | None = None

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

        Raises:
            ConfigError: no such column (names the nearest), or several.
        """
        found = [(s, c) for s in self.streams for c in s.fields if full(s, c) == name]
        found = found or [(s, c) for s in self.streams for c in s.fields if c == name]
        if len(found) == 1:
            return found[0]
        if found:
            where = ", ".join(full(s, c) for s, c in found)
            raise ConfigError(f"the mapping reads {name!r}, which {self.source} has more than once: {where}.")
        known = self.names()
        near = difflib.get_close_matches(name, known, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        shown = ", ".join(known[:12]) + (", ..." if len(known) > 12 else "")
        raise ConfigError(
            f"the mapping reads {name!r}, which {self.source} does not have.{hint} It has {shown}."
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
