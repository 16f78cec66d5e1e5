"""Runs as a batch of chunks that overlap: what a filter knew long ago it has forgotten.

Each chunk begins `burn` rows before those that it counts, where its filter starts from the measured row. Chunks advance
side by side, so that a pass over a log of any length takes as many steps as one chunk is long.
"""

import copy
from typing import final

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array, Labels
from nsde_torch.inference.steps import Steps

# what is not counted of a chunk, and what is, where that is as many rows as below
_BURN_S, _LENGTH_S = 0.5, 2.0
_BURN, _LENGTH = (30, 300), (60, 600)  # fewest and most rows
_BLOCK_S = 0.5  # of a cluster of the robust covariance, at least
_FEWEST_BLOCKS = 20


@final
class Chunks:
    """The rows of some steps, (rows of a chunk, chunks, columns).

    Args:
        late: Rows after the start of a stretch that are not counted either: there, a state that no sensor measures is
            known from what came later.
        every: Rows from one measurement of the slowest sensor to the next.

    Attributes:
        y: Measured states (T, C, nx).
        u: Inputs held from each row on (T, C, nu).
        t: Logged time of each row (T, C) [s].
        counted: Whether the innovation of a row is part of the likelihood (T, C).
        stretch: Number of the stretch of each chunk (C,).
        row: Number of the step that starts at each row (T, C); of a last row, that of the one before.
        since: Rows since the start of the stretch (T, C).
        parts: Ranges of rows of a chunk that are one block of time each.
    """

    def __init__(self, steps: Steps, *, late: int = 0, every: int = 1) -> None:
        h = steps.dt
        # with states that no sensor measures, or not in each row, a filter remembers for longer
        slower = 2.0 if late or every > 1 else 1.0
        burn, length = (
            int(slower * np.clip(round(seconds / h), *rows))
            for seconds, rows in ((_BURN_S, _BURN), (_LENGTH_S, _LENGTH))
        )
        longest = max(b - a + 1 for a, b in steps.segments)
        size = min(burn + length, longest)
        first, counted, last, owners, stretch = [], [], [], [], []
        for number, ((a, b), owner) in enumerate(zip(steps.segments, steps.runs, strict=True)):
            done, end = a + 1, b + 1  # rows of a stretch: one more than its steps
            while done < end:
                start = max(a, min(done - burn, end - size))
                own = np.arange(start, start + size)
                counted.append((own >= max(done, a + 1 + late)) & (own < end))
                first.append(start)
                last.append(b)
                owners.append(owner)
                stretch.append(number)
                done = start + size
        begun, end_of = np.array(first), np.array(last)
        rows = begun[None, :] + np.arange(size)[:, None]
        ended = rows >= end_of[None, :]
        step = np.where(ended, end_of[None, :] - 1, rows)
        self.row = torch.from_numpy(step)
        self.since = torch.from_numpy(rows - np.array([steps.segments[s][0] for s in stretch]))
        self.y = torch.where(torch.from_numpy(ended)[..., None], steps.seen1[self.row], steps.seen0[self.row])
        self.u, self.t = steps.u[self.row], steps.t[self.row]
        self.counted = torch.from_numpy(np.array(counted).T.copy())
        total = int(self.counted.sum()) * h
        block = max(1, round(min(max(_BLOCK_S, 0.01 * total), total / _FEWEST_BLOCKS) / h))
        pieces = max(1, round(size / block))
        self.parts = [(size * p // pieces, size * (p + 1) // pieces) for p in range(pieces)]
        self.size, self.count = size, len(first)
        self._owners, self.stretch = torch.tensor(owners), torch.tensor(stretch)

    @property
    def follows(self) -> Tensor:
        """Whether the chunk before each holds its first row (C,): not of the first of a stretch."""
        row = self.row[0].diff(prepend=self.row[0, :1])
        return self.stretch.diff(prepend=self.stretch[:1] - 1).eq(0) & (row >= 0) & (row < self.size)

    def in_turn(self, values: Tensor) -> Tensor:
        """Values (T, C, k) at the first row of each chunk, from the one before it (C, k); of the first its own."""
        before = (torch.arange(self.count) - 1).clamp_min(0)
        return values[torch.where(self.follows, self.row[0] - self.row[0, before], 0), before]

    def some(self, which: Tensor) -> "Chunks":
        """Some of the chunks, by number."""
        out = copy.copy(self)
        out.row, out.since, out.y, out.u, out.t, out.counted = (
            part[:, which] for part in (self.row, self.since, self.y, self.u, self.t, self.counted)
        )
        out._owners, out.stretch = self._owners[which], self.stretch[which]
        out.count = len(which)
        return out

    def cut(self, values: Tensor) -> Tensor:
        """Values of steps (N, k) at the rows of the chunks (T, C, k)."""
        return values[self.row]

    def blocks(self, values: Tensor) -> Array:
        """Those blocks of (parts, C, ...) in which any row counts (B, ...)."""
        live = torch.stack([self.counted[a:b].any(0) for a, b in self.parts])
        return np.asarray(values[live].numpy())

    def places(self) -> tuple[Labels, Labels]:
        """Number of the run of each block, and of the step that it begins with (B,), in the order of `blocks`."""
        count = len(self.parts)
        begun = self.row[[a for a, _ in self.parts]]  # of a block with the last row alone: the last step
        owners, firsts = self.blocks(self._owners.expand(count, -1)), self.blocks(begun)
        return owners.astype(np.int64), firsts.astype(np.int64)
