"""Rows of several stretches one after another: what must not reach across a gap."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Series:
    """Stretches of rows."""

    edges: tuple[tuple[int, int], ...]  # ranges (first, last + 1), adjacent and in order

    def __len__(self) -> int:
        return self.edges[-1][1]

    @property
    def place(self) -> NDArray[np.int64]:
        """Row number inside its stretch (N,)."""
        return np.concatenate([np.arange(b - a) for a, b in self.edges])

    def lagged(self, values: Array, lags: Sequence[int]) -> Array:
        """Columns (N, n) of so many rows before, side by side (N, n len(lags)); zero where a stretch had not begun."""
        place, parts = self.place[:, None], [values[:, :0]]
        for lag in lags:
            moved = np.zeros_like(values)
            moved[lag:] = values[: len(values) - lag] if lag else values
            parts.append(np.where(place >= lag, moved, 0.0))
        return np.concatenate(parts, 1)

    def shifted(self, values: Array, by: int) -> Array:
        """Values (N, ...) of so many rows later, of the first or last row where a stretch has none."""
        rows = [np.clip(np.arange(a, b) + by, a, b - 1) for a, b in self.edges]
        return np.asarray(values[np.concatenate(rows)])

    def boxes(self, width: int) -> "Series":
        """Series of the sums that `summed` makes."""
        ends = np.cumsum([(b - a) // width for a, b in self.edges]).tolist()
        return Series(tuple(zip([0, *ends[:-1]], ends, strict=True)))

    def summed(self, values: Array, width: int) -> Array:
        """Sums over boxes of `width` rows (M, ...); what is left over at the end of a stretch is dropped."""
        if width == 1:
            return values
        parts = []
        for a, b in self.edges:
            count = (b - a) // width
            cut = values[a : a + count * width]
            parts.append(cut.reshape(count, width, *values.shape[1:]).sum(1))
        return np.concatenate(parts)

    def blocks(self, rows: int) -> NDArray[np.int64]:
        """Number of the block of each row (N,): every stretch in equal blocks of about `rows` rows."""
        labels, first = [], 0
        for a, b in self.edges:
            count = max(1, round((b - a) / rows))
            labels.append(first + np.minimum(np.arange(b - a) * count // (b - a), count - 1))
            first += count
        return np.concatenate(labels)
