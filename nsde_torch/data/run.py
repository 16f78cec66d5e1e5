"""A run is one continuous recording; a data set is a list of runs of one system on one time step."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.errors import DataError, ShapeError
from nsde_torch.shown import data_frame, preformatted

if TYPE_CHECKING:
    from nsde_torch.data.raw import Finding
    from nsde_torch.data.summary import DataSummary


@dataclass(frozen=True)
class Split:
    """Runs for training and runs held out for the test."""

    train: tuple[Run, ...]
    test: tuple[Run, ...]


def split(
    dataset: DataSet, test: Sequence[int | str] | None = None, *, train: Sequence[int | str] | None = None
) -> Split:
    """Splits a data set by whole runs: the runs of both sides, in its order.

    Runs to hold out are named by index or name; None holds out the last run, and trains on all others. A DataError
    refuses an unknown run, a run or an equal content on both sides, or an empty side.

    Example:
        >>> split(dataset, test=[1]).train  # doctest: +SKIP
    """
    runs = dataset.runs
    if isinstance(test, int | str):
        raise DataError(f"`test` must be a list of runs; got {test!r}. Write [{test!r}].")
    if len(runs) == 1 and test is None and train is None:
        raise DataError(
            f"the data set holds one run ({runs[0].name!r}), which cannot be on both sides. Record a second "
            "run, or set `test` to [] to train on it and test on nothing."
        )
    held = resolve(runs, [len(runs) - 1] if test is None else test)
    kept = [k for k in range(len(runs)) if k not in held] if train is None else resolve(runs, train)
    for side, indices in (("test", held), ("train", kept)):
        twice = sorted({runs[k].name for k in indices if indices.count(k) > 1})
        if twice:
            raise DataError(f"`{side}` names the runs {twice} more than once.")
    if not kept:
        names = ", ".join(run.name for run in runs)
        raise DataError(
            f"no run is left for training: all of the {len(runs)} runs ({names}) are held out in `test`. "
            "Hold out fewer."
        )
    both = sorted(set(held) & set(kept))
    if both:
        raise DataError(
            f"the runs {[runs[k].name for k in both]} are in both `train` and `test`; a test on training "
            "data says nothing. Remove them from one side."
        )
    seen: dict[str, str] = {}
    for k in kept:
        twin = seen.setdefault(runs[k].content_hash, runs[k].name)
        if twin != runs[k].name:
            raise DataError(
                f"the training runs {twin!r} and {runs[k].name!r} have the same content, which would count it twice "
                "and spoil the calibration across runs. Remove one."
            )
    for k in held:
        if twin := seen.get(runs[k].content_hash, ""):
            raise DataError(
                f"the test run {runs[k].name!r} has the same content as the training run {twin!r}; a test on "
                "training data says nothing. Hold out both, or remove one."
            )
    return Split(train=tuple(runs[k] for k in sorted(kept)), test=tuple(runs[k] for k in sorted(held)))


def _frozen(name: str, value: object, ndim: int) -> Array:
    """A read-only float64 view (a copy only where the type differs), with the number of axes checked."""
    array = np.ascontiguousarray(value, dtype=np.float64)
    if array.ndim != ndim:
        axes = "(n,)" if ndim == 1 else "(n, columns)"
        raise ShapeError(f"`{name}` must be {axes}; got shape {array.shape}.")
    view = array.view()
    view.flags.writeable = False
    return view


@dataclass(frozen=True, eq=False)
class Run:
    """One continuous recording; `u[k]` holds from `t[k]` to `t[k + 1]`.

    A ShapeError where an array has the wrong number of axes or rows; a DataError where a value is not finite, the time
    does not increase, or the segments do not fit.
    """

    name: str  # name of the run, unique in its data set
    t: Array  # time of each row [s], (n,), strictly increasing; one step inside a segment
    x: Array  # states, (n, nx), SI units
    u: Array  # inputs and then the exogenous channels that the system reads, (n, nu)
    segments: tuple[tuple[int, int], ...] = ()
    """Index ranges (start, stop) without a gap, in order, each of two rows or more; default: all rows."""
    source: str = ""  # where the run came from (file name), for messages
    extra: Mapping[str, Array] = field(default_factory=dict)  # further logged columns by name, each (n,)
    band: Mapping[str, float] = field(default_factory=dict)
    """States that were smoothed before they were logged, and the frequency up to which they are restored [Hz]."""
    low_pass: Mapping[str, float] = field(default_factory=dict)
    """Of `band`, states with louder noise above it than below, as what was removed there must not weigh."""
    apart: Mapping[str, int] = field(default_factory=dict)
    """States whose noise is correlated from row to row, because a filter or a delay was undone, and the rows from which
    it no longer is."""
    inferred: Mapping[str, float] = field(default_factory=dict)
    """States that no sensor measured and that were inferred from positions: what is not known of them (standard
    deviation, their unit)."""
    ahead: float = 0.0
    """Time by which the inputs are earlier than in the log, as the mean of a row and the next one is [s of the log]."""
    pace: float = 1.0
    """Times in seconds that are typical of drives and vehicles are multiplied by this (`nsde_torch.data.pace`)."""
    unbroken: tuple[tuple[int, int], ...] = ()
    """Ranges without a gap that the segments are parts of, where rows between these were left out of a regression
    alone: they still say what an effect with memory held. Default: none but the segments."""

    def __post_init__(self) -> None:
        set_field = object.__setattr__
        set_field(self, "t", _frozen("t", self.t, 1))
        set_field(self, "x", _frozen("x", self.x, 2))
        set_field(self, "u", _frozen("u", self.u, 2))
        set_field(self, "extra", {k: _frozen(f"extra[{k!r}]", v, 1) for k, v in self.extra.items()})
        n = len(self.t)
        arrays = {"t": self.t, "x": self.x, "u": self.u, **self.extra}
        for name, array in arrays.items():
            if len(array) != n:
                raise ShapeError(
                    f"run {self.name!r}: `{name}` must have one row for each of the {n} times; got "
                    f"{len(array)} rows."
                )
        if n < 2:
            raise DataError(
                f"run {self.name!r} has {n} row(s); a run needs at least two. Remove it from the data set."
            )
        segments = tuple((int(a), int(b)) for a, b in self.segments) or ((0, n),)
        set_field(self, "segments", segments)
        previous = 0
        for start, stop in segments:
            if not previous <= start < stop <= n or stop - start < 2:
                raise DataError(
                    f"run {self.name!r}: segments must be increasing (start, stop) pairs of two rows or more "
                    f"inside 0..{n}; got {segments}."
                )
            previous = stop
        for name, array in arrays.items():
            # the sum is finite exactly when all entries are (barring overflow), and needs no mask of their size
            if not np.isfinite(array.sum()) and not np.isfinite(array).all():
                row = int(np.argwhere(~np.isfinite(array))[0][0])
                raise DataError(
                    f"run {self.name!r}: `{name}` is not finite in row {row}. Read it through "
                    "`nsde_torch.recording.read`, which treats missing values."
                )
        if not (np.diff(self.t) > 0).all():
            row = int(np.argmax(np.diff(self.t) <= 0))
            raise DataError(
                f"run {self.name!r}: `t` must increase; it goes from {self.t[row]:.6g} s to "
                f"{self.t[row + 1]:.6g} s after row {row}."
            )

    def __repr__(self) -> str:
        return f"<Run {self.name!r}: {len(self)} rows, {self.duration:.4g} s>"

    def __len__(self) -> int:
        return len(self.t)

    @cached_property
    def dt(self) -> float:
        """Time step inside the segments [s] (median)."""
        steps = np.concatenate([np.diff(self.t[a:b]) for a, b in self.segments])
        return round(float(np.median(steps)), 12)

    @property
    def duration(self) -> float:
        """Recorded time inside the segments [s], gaps left out."""
        return float(sum(self.t[b - 1] - self.t[a] for a, b in self.segments))

    @cached_property
    def content_hash(self) -> str:
        """SHA-256 of states and inputs as float64 bytes; equal for equal content under any name or clock."""
        digest = hashlib.sha256(repr((self.x.shape, self.u.shape)).encode())
        for array in (self.x, self.u):
            digest.update(array.data)
        return digest.hexdigest()

    def slice(self, start: int, stop: int, *, name: str | None = None) -> Run:
        """Rows start..stop (not included) as a run, without segments below two rows; DataError where none has two."""
        start, stop, _ = slice(start, stop).indices(len(self))
        cut = [(max(a, start) - start, min(b, stop) - start) for a, b in self.segments]
        segments = tuple((a, b) for a, b in cut if b - a >= 2)
        if not segments:
            raise DataError(
                f"run {self.name!r}: rows {start}..{stop} hold no segment of two rows; the run has "
                f"{len(self)} rows and segments {self.segments}."
            )
        rows = slice(start, stop)
        extra = {k: v[rows] for k, v in self.extra.items()}
        new = f"{self.name}[{start}:{stop}]" if name is None else name
        part: dict[str, Any] = {"t": self.t[rows], "x": self.x[rows], "u": self.u[rows], "extra": extra}
        return replace(self, name=new, segments=segments, unbroken=(), **part)


def fingerprint(runs: Sequence[Run], *, system_name: str, dt: float, clock_scale: float) -> str:
    """Content hash of a data set: equal data, segments, step and clock give equal fingerprints."""
    digest = hashlib.sha256(f"{system_name}|{dt!r}|{clock_scale!r}".encode())
    for run in runs:
        digest.update(f"|{run.name}|{run.segments}|{run.content_hash}|".encode())
        digest.update(run.t.data)
        for name in sorted(run.extra):
            digest.update(name.encode())
            digest.update(run.extra[name].data)
    return digest.hexdigest()


@dataclass(frozen=True, eq=False)
class DataSet:
    """Runs of one system on one step, checked and summarised.

    A DataError where there are no runs, runs of unequal width, or two runs of one name.
    """

    system_name: str  # name of the system that the columns belong to
    runs: Sequence[Run]  # the runs; names are unique
    dt: float  # time step of every segment [s], as logged
    clock_scale: float
    """Physical seconds for each logged second; 1.0 where clock and kinematics agree or are trusted."""
    summary: DataSummary  # what was found and done, and the figures of the data
    fingerprint: str  # content hash (SHA-256)
    state_names: tuple[str, ...]  # names of the columns of `x`
    input_names: tuple[str, ...]
    """Names of the columns of `u`: inputs, then the exogenous channels that the system reads."""
    kind: str = ""  # reader that made it

    def __post_init__(self) -> None:
        object.__setattr__(self, "runs", tuple(self.runs))
        if not self.runs:
            raise DataError("a data set needs at least one run; got none.")
        names = [run.name for run in self.runs]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise DataError(f"run names must be unique; {twice} occur more than once.")
        for run in self.runs:
            if run.x.shape[1] != len(self.state_names) or run.u.shape[1] != len(self.input_names):
                raise ShapeError(
                    f"run {run.name!r} has {run.x.shape[1]} states and {run.u.shape[1]} inputs; expected "
                    f"{len(self.state_names)} {self.state_names} and {len(self.input_names)} "
                    f"{self.input_names}."
                )

    def __repr__(self) -> str:
        size = f"{len(self.runs)} runs, {self.duration:.1f} s at {1 / self.dt:.4g} Hz"
        return f"<DataSet of {self.system_name}: {size}>"

    def _repr_html_(self) -> str:
        return preformatted(str(self.summary))

    def to_frame(self) -> Any:
        """A `pandas.DataFrame` of all rows: `run`, `t` [s], the states, the inputs, and what else every run holds."""
        shared = set.intersection(*(set(run.extra) for run in self.runs)) - set(self.input_names)
        columns: dict[str, Any] = {"run": np.repeat(self.names, [len(run) for run in self.runs])}
        columns["t"] = np.concatenate([run.t for run in self.runs])
        columns |= zip(self.state_names, np.concatenate([run.x for run in self.runs]).T, strict=True)
        columns |= zip(self.input_names, np.concatenate([run.u for run in self.runs]).T, strict=True)
        columns |= {name: np.concatenate([run.extra[name] for run in self.runs]) for name in sorted(shared)}
        return data_frame(columns)

    def __len__(self) -> int:
        return len(self.runs)

    def __iter__(self) -> Iterator[Run]:
        return iter(self.runs)

    def __getitem__(self, key: int | str) -> Run:
        """A run by index or by name."""
        return self.runs[resolve(self.runs, [key])[0]]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the runs, in order."""
        return tuple(run.name for run in self.runs)

    @property
    def duration(self) -> float:
        """Recorded time inside the segments of all runs [s]."""
        return sum(run.duration for run in self.runs)

    def changed(self, runs: Sequence[Run], findings: Sequence[Finding]) -> DataSet:
        """The data set with its runs changed, a fingerprint of theirs, and all findings that its summary says."""
        mark = fingerprint(runs, system_name=self.system_name, dt=self.dt, clock_scale=self.clock_scale)
        told = replace(self.summary, findings=tuple(findings))
        return replace(self, runs=runs, summary=told, fingerprint=mark)


def resolve(runs: Sequence[Run], keys: Sequence[int | str]) -> list[int]:
    """Indices of the runs named by index (negative from the end), digits or name; a DataError lists the choices."""
    names = [run.name for run in runs]
    out = []
    for key in keys:
        if isinstance(key, str) and key in names:
            out.append(names.index(key))
            continue
        try:
            index = int(key)
        except ValueError:
            index = len(runs)
        if isinstance(key, bool) or not -len(runs) <= index < len(runs):
            choices = ", ".join(f"{i}: {n}" for i, n in enumerate(names[:20])) + ", ..." * (len(names) > 20)
            raise DataError(f"no run {key!r}; choose by index or name among the {len(runs)} runs: {choices}.")
        out.append(index % len(runs))
    return out
