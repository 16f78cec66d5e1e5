"""One file of a log: streams, and what the format says of their meaning."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from nsde_torch.data.formats.clock import ClockOf
from nsde_torch.data.streams import Stream
from nsde_torch.errors import ConfigError, DataError


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
        clock: How a table was taken to tell the time; None: the format says it.
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


def lacking(package: str, extra: str, path: Path) -> ConfigError:
    """The error where an optional package is not installed."""
    return ConfigError(
        f"{path.name} needs the package {package!r}, which is not installed: pip install 'nsde_torch[{extra}]'."
    )


def unreadable(path: Path, what: str, error: Exception | str) -> DataError:
    """The error for a file that its parser refuses."""
    reason = error if isinstance(error, str) else f"{type(error).__name__}: {error}"
    return DataError(
        f"{path} is not a readable {what} ({' '.join(reason.split())[:200]}). It may be cut short or of another "
        "format: copy it again, unpack an archive, or save a table as CSV in UTF-8."
    )
