"""A recording as a reader hands it over: perhaps without a clock, with holes (`nan`), before any check."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nsde_torch.arrays import Array
from nsde_torch.data.system_info import SystemInfo


@dataclass(frozen=True)
class Finding:
    """One kind of fault in one run (or in the whole data set)."""

    kind: str  # short name of the fault, such as `time_gap` or `sign_flip`
    run: str  # name of the run; empty for the whole data set
    count: int  # how often it occurs
    message: str  # what was found, with numbers and units
    action: str
    """What was done: `split`, `resampled`, `interpolated`, `dropped`, `sorted`, `normalised`, `unwrapped`, `rescaled`,
    `reported`."""
    values: dict[str, Any] = field(default_factory=dict)  # the numbers by name (units in the names)

    def as_dict(self) -> dict[str, Any]:
        """Plain containers, for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        place = f"{self.run}: " if self.run else ""
        return f"{place}{self.message} -> {self.action}"


Report = Callable[[Finding], None]  # takes what a check found


@dataclass
class RawRun:
    """What a reader returns; `nsde_torch.recording.assemble` turns it into a `Run`."""

    name: str  # name of the run
    t: Array  # time of each row [s], (n,); any start, any order
    x: Array  # states, (n, nx); `nan` means missing
    u: Array  # inputs, (n, nu) or (n - 1, nu) where the last row has none; `nan` means missing
    extra: Mapping[str, Array] = field(default_factory=dict)  # further columns by name, each (n,)
    source: str = ""  # file, for messages
    first_line: int | None = None
    """Line of row 0 in a text file, so that messages can say file:line; None for other files."""
    notes: list[Finding] = field(default_factory=list)  # what the reader itself found; goes to the summary

    @property
    def label(self) -> str:
        """Source and name, for messages."""
        return f"{self.source or 'run'} {self.name!r}"

    def where(self, row: int) -> str:
        """Place of a row, for messages: file:line for a text file, otherwise run and row."""
        if self.first_line is not None:
            return f"{self.source}:{self.first_line + row}"
        return f"{self.label} row {row}"

    def rows(self, index: NDArray[np.int64] | NDArray[np.bool_] | slice) -> None:
        """Keep these rows of every column, in this order (messages about lines are off from here on)."""
        self.t, self.x, self.u = self.t[index], self.x[index], self.u[index]
        self.extra = {k: v[index] for k, v in self.extra.items()}
        self.first_line = None


def run_of(
    columns: Mapping[str, Array], t: Array, system: SystemInfo, *, name: str, source: str, **more: Any
) -> RawRun:
    """A run from columns by name: a state that is not there is missing, an input zero; others are further columns."""
    nothing, u = np.full(len(t), np.nan), np.zeros((len(t), len(system.input_names)))
    x = np.column_stack([columns.get(state, nothing) for state in system.state_names])
    for k, one in enumerate(system.input_names):
        u[:, k] = columns.get(one, 0.0)
    own = {*system.state_names, *system.input_names}
    extra = {key: values.copy() for key, values in columns.items() if key not in own}
    return RawRun(name, t, x, u, extra=extra, source=source, **more)


def holes(bad: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Index ranges (start, stop) of consecutive True values."""
    edge = np.flatnonzero(np.diff(np.concatenate([[False], bad, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edge[::2], edge[1::2], strict=True)]
