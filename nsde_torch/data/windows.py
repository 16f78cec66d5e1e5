"""Windows: `horizon` model steps cut from runs when asked for, never across a gap.

A window that starts at sample `s` of a run holds the states at samples s, s + k, ..., s + horizon k (k =
model step over data step) and, for each model step, the mean of the k inputs that were held during it:

    u[j] = (U[s + j k] + ... + U[s + j k + k - 1]) / k

Only the columns are stored (one float32 copy of the data); the starts are index ranges. So memory is that of
the data.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from copy import copy
from dataclasses import KW_ONLY, InitVar, dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.data.denoise import denoised
from nsde_torch.data.interventions import interventional, stretches
from nsde_torch.data.run import Run
from nsde_torch.errors import ConfigError, DataError

Ranges = NDArray[np.int64]
Indices = Tensor | NDArray[np.int64] | Sequence[int]
TOLERANCE = 0.01  # share by which a step may miss a whole multiple of the data's


@dataclass(eq=False)
class Windows:
    """All windows of some runs; cut lazily.

    A ConfigError where the steps do not divide, or the horizon is not positive; a DataError where there are no runs, or
    no segment is as long as a window.

    Example:
        >>> windows = Windows(runs, dt_model=0.05, horizon=20)  # doctest: +SKIP
        >>> x, u, t0 = windows.batch(windows.sample(512, generator))  # doctest: +SKIP
    """

    runs: InitVar[Sequence[Run]]  # all on one step
    dt_model: float  # step of the model [s], a whole multiple of the step of the data (within 1 %)
    horizon: int  # model steps in a window
    _: KW_ONLY
    dtype: InitVar[torch.dtype] = torch.float32  # type of the tensors
    device: InitVar[str | torch.device] = "cpu"  # where the data live and the batches are cut
    denoise: InitVar[bool] = False  # whether white sensor noise is taken out of `initial_states`

    def __post_init__(
        self, runs: Sequence[Run], dtype: torch.dtype, device: str | torch.device, denoise: bool
    ) -> None:
        runs, dt_model, horizon = tuple(runs), float(self.dt_model), self.horizon
        if not runs:
            raise DataError("`runs` is empty; windows need at least one run.")
        if isinstance(horizon, bool) or horizon < 1 or int(horizon) != horizon:
            raise ConfigError(f"`horizon` must be a whole number of steps, at least 1; got {horizon!r}.")
        data_dt = runs[0].dt
        for run in runs:
            if abs(run.dt / data_dt - 1) > TOLERANCE:
                raise DataError(
                    f"run {run.name!r} has a step of {run.dt:.6g} s, the others {data_dt:.6g} s; read them "
                    "as one data set, which resamples them."
                )
        ratio = dt_model / data_dt
        if not ratio > 0 or round(ratio) < 1 or abs(ratio / round(ratio) - 1) > TOLERANCE:
            low = max(1, int(ratio))
            raise ConfigError(
                f"`dt_model` must be a whole multiple of the data's step of {data_dt:.6g} s (within 1 %); "
                f"got {dt_model:.6g} s, {ratio:.4g} steps. Take {low * data_dt:.6g} or "
                f"{(low + 1) * data_dt:.6g} s, or read the data with another `dt`."
            )
        self.dt_model, self.horizon, self.dt, self.pace = dt_model, int(horizon), data_dt, runs[0].pace
        self.stride = round(ratio)
        self.run_names = tuple(run.name for run in runs)
        lengths = np.array([len(run) for run in runs])
        self._first = np.concatenate([[0], np.cumsum(lengths)])[:-1].astype(np.int64)
        total = int(lengths.sum())
        self._x = torch.empty(total, runs[0].x.shape[1], dtype=dtype)
        self._u = torch.empty(total, runs[0].u.shape[1], dtype=dtype)
        placed = list(zip(runs, self._first.tolist(), strict=True))
        for run, at in placed:  # not by torch.from_numpy, which wants writable arrays
            self._x[at : at + len(run)].numpy()[...] = run.x
            self._u[at : at + len(run)].numpy()[...] = run.u
        ranges = [(at + a, at + b) for run, at in placed for a, b in run.segments]
        self._interventions: list[tuple[int, int]] | None = None  # rows (start, stop) in the joined runs
        if interventional(runs):
            self._interventions = [(at + a, at + b) for run, at in placed for a, b in stretches(run) or ()]
        self._t = np.concatenate([run.t for run in runs])
        self._x, self._u = self._x.to(device), self._u.to(device)
        self._smooth: Tensor | None = None
        self.start_share = torch.ones(self._x.shape[1], dtype=dtype, device=device)
        """Noise that is left in `initial_states`, as a share of that of the sensors (nx,)."""
        if denoise:
            smooth, share = denoised(runs)
            self._smooth = torch.from_numpy(np.concatenate(smooth)).to(self._x)
            self.start_share = torch.from_numpy(share).to(self._x)
        self._segments = np.array([a for a, _ in ranges], dtype=np.int64)
        self._set_ranges(np.array(ranges, dtype=np.int64))
        if len(self) == 0:
            longest = int((self._ranges[:, 1] - self._ranges[:, 0]).max())
            raise DataError(
                f"no segment is as long as a window of {self.horizon} steps of {self.dt_model:.4g} s "
                f"({self.span + 1} rows); the longest has {longest}. Shorten `horizon`."
            )

    @property
    def interventional(self) -> bool:
        """Whether `starts` are those of interventions, whose inputs were set from outside."""
        return self._interventions is not None

    @property
    def span(self) -> int:
        """Samples from the first to the last row of a window; a window covers `span + 1` rows."""
        return self.horizon * self.stride

    def _set_ranges(self, ranges: Ranges) -> None:
        """Row ranges [start, stop) inside which windows must lie, and the number of starts in each."""
        self._ranges = ranges.reshape(-1, 2)
        self._counts = np.maximum(self._ranges[:, 1] - self._ranges[:, 0] - self.span, 0)
        self._ends = np.cumsum(self._counts)

    def _with(self, ranges: Ranges, horizon: int) -> Windows:
        """The same data with other row ranges; the tensors are shared."""
        other = copy(self)
        other.horizon = horizon
        other._set_ranges(ranges)
        return other

    def shortened(self, horizon: int) -> Windows:
        """The same rows cut into windows of at most as many steps; the tensors are shared."""
        if not 1 <= horizon <= self.horizon:
            raise ConfigError(
                f"`horizon` must lie in 1..{self.horizon}, the steps of these windows; got {horizon!r}."
            )
        return self._with(self._ranges, horizon)

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def rows(self, indices: Indices) -> NDArray[np.int64]:
        """Row (of the joined runs) at which each window starts, (B,)."""
        index = np.asarray(indices, dtype=np.int64).reshape(-1)
        if len(index) and not (index.min() >= 0 and index.max() < len(self)):
            raise IndexError(
                f"window indices must lie in 0..{len(self) - 1}; got {index.min()}..{index.max()}."
            )
        part = np.searchsorted(self._ends, index, side="right")
        start: NDArray[np.int64] = self._ranges[part, 1] - self.span - self._ends[part] + index
        return start

    def locate(self, indices: Indices) -> list[tuple[str, int]]:
        """(run name, first sample in the run) of each window."""
        rows = self.rows(indices)
        names = [self.run_names[run] for run in np.searchsorted(self._first, rows, side="right") - 1]
        return list(zip(names, self._samples(rows).tolist(), strict=True))

    def _samples(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Rows of the joined runs, counted from the first row of their run."""
        return rows - self._first[np.searchsorted(self._first, rows, side="right") - 1]

    def batch(self, indices: Indices) -> tuple[Tensor, Tensor, Tensor]:
        """Windows by their numbers (B,), each in 0..len - 1, else an IndexError.

        States at the model's steps (B, horizon + 1, nx), inputs averaged over each (B, horizon, nu), and the logged
        time of the first row [s], float64, (B,).
        """
        rows = self.rows(indices)
        device = self._x.device
        start = torch.from_numpy(rows).to(device)
        at = start[:, None] + torch.arange(0, self.span + 1, self.stride, device=device)
        x = self._x[at]
        held = start[:, None] + torch.arange(self.span, device=device)
        u = self._u[held]
        if self.stride > 1:
            u = u.unflatten(1, (self.horizon, self.stride)).mean(dim=2)
        return x, u, torch.from_numpy(self._t[rows]).to(device)

    def before(self, indices: Indices, steps: int) -> Tensor:
        """Inputs before windows, (B, steps, nu): means over the model's steps that end at the first row, oldest first.

        They are those of the same segment; where it began later, its first input is repeated. Rows that a split has
        given to others are read all the same: inputs are not what is predicted.
        """
        if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
            raise ConfigError(f"`steps` must be a whole number of at least 1; got {steps!r}.")
        start = self.rows(indices)
        first = self._segments[np.searchsorted(self._segments, start, side="right") - 1]
        back = np.arange(-steps * self.stride, 0)
        at = np.maximum(start[:, None] + back, first[:, None])
        u = self._u[torch.from_numpy(at).to(self._u.device)]
        return u.unflatten(1, (steps, self.stride)).mean(dim=2)

    def initial_states(self, indices: Indices) -> Tensor:
        """States from which paths of the windows start (B, nx): the first rows, without sensor noise if asked for."""
        rows = torch.from_numpy(self.rows(indices)).to(self._x.device)
        return (self._x if self._smooth is None else self._smooth)[rows]

    def sample(self, size: int, generator: torch.Generator) -> Tensor:
        """Window numbers drawn with replacement, (size,); the same generator state gives the same numbers."""
        return torch.randint(len(self), (size,), generator=generator)

    def starts(self, every_s: float) -> Tensor:
        """Windows to evaluate: on the regular grid 0, every_s, 2 every_s, ... of their run, or at interventions.

        The grid counts samples from the first row of each run, so that every model is scored from the same
        starts; those whose window would leave its segment are left out. Give the windows the longest horizon
        of interest. Runs with a column `intervention` are scored from where it changes from 0 to 1 (see
        `data.interventions`), and from nowhere else. `every_s` [s] is a whole number of data steps (within 1 %).
        """
        steps = every_s / self.dt
        if round(steps) < 1 or abs(steps / round(steps) - 1) > TOLERANCE:
            raise ConfigError(
                f"`every_s` must be a whole multiple of the data's step of {self.dt:.6g} s; got {every_s:.6g}."
            )
        rows = self.rows(np.arange(len(self)))
        if self._interventions is None:
            chosen = self._samples(rows) % round(steps) == 0
        else:
            chosen = np.isin(rows, [a for a, b in self._interventions if a + self.span < b])
        return torch.from_numpy(np.flatnonzero(chosen))

    def held_out(
        self, fraction: float, block_s: float, generator: torch.Generator
    ) -> tuple[Windows, Windows]:
        """Splits into training and validation windows that share no row.

        Time is cut into blocks of a length [s], in which at least one window fits, else they are made as long; a random
        share of them, a `fraction` in (0, 1) of the rows, is held out. Windows that would cross from a training block
        into a held-out one belong to neither (they are purged). Both share the stored data. A DataError where these are
        too short to hold anything out.
        """
        if not 0 < fraction < 1:
            raise ConfigError(
                f"`fraction` must lie between 0 and 1; got {fraction!r}. Use no validation instead of 0."
            )
        if not block_s > 0:
            raise ConfigError(f"`block_s` must be positive; got {block_s!r}.")
        need = self.span + 1
        block = max(round(block_s / self.dt), need)
        usable = self._ranges[self._ranges[:, 1] - self._ranges[:, 0] >= need]
        # borders of equal blocks of at least so many rows, one block at least
        edges = [
            np.linspace(a, b, max(1, (b - a) // block) + 1).round().astype(int).tolist() for a, b in usable
        ]
        if len(edges) == 1 and len(edges[0]) == 2:
            # one block in all: its end, at least one window, is held out
            a, b = edges[0]
            cut = b - max(need, round(fraction * (b - a)))
            if cut - a < need:
                raise DataError(
                    f"the only segment has {b - a} rows; a training and a validation window of {need} rows each "
                    "do not fit. Shorten `horizon`, or use no validation."
                )
            edges = [[a, cut, b]]
            held = {(cut, b)}
        else:
            held = _choose([pair for e in edges for pair in itertools.pairwise(e)], fraction, generator)
        train: list[tuple[int, int]] = []
        validation: list[tuple[int, int]] = []
        for e in edges:
            for out, blocks in itertools.groupby(itertools.pairwise(e), held.__contains__):
                ends = [end for block in blocks for end in block]
                (validation if out else train).append((ends[0], ends[-1]))
        first, second = (self._with(np.array(r, dtype=np.int64), self.horizon) for r in (train, validation))
        if len(first) == 0 or len(second) == 0:
            raise DataError(
                f"the data are too short to hold out {fraction:.0%}: {len(first)} training and {len(second)} "
                f"validation windows of {need} rows would be left. Shorten `horizon`, or use no validation."
            )
        return first, second


def _choose(
    blocks: Sequence[tuple[int, int]], fraction: float, generator: torch.Generator
) -> set[tuple[int, int]]:
    """Random blocks that hold about this share of the rows: at least one, and never all."""
    goal = fraction * sum(b - a for a, b in blocks)
    held: set[tuple[int, int]] = set()
    taken = 0
    for index in torch.randperm(len(blocks), generator=generator).tolist():
        a, b = blocks[index]
        if held and (taken + 0.5 * (b - a) > goal or len(held) == len(blocks) - 1):
            break
        held.add((a, b))
        taken += b - a
    return held
