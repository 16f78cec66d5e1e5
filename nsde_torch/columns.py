"""Tables (N, n) that lie in memory column by column, so that arithmetic on columns runs over adjacent numbers.

Shapes and values are those of torch.stack and torch.cat along the last axis; only the strides differ. A rollout
keeps its states so, and what is computed from them stays so as long as it is put together here.

Within `few_operations` tables are put together row by row, with one operation each: an interpreter pays for operations
and not for strides. Values are the same.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor

_few = False


@contextmanager
def few_operations() -> Iterator[None]:
    """Write what is traced within with as few operations as there can be, for an interpreter of graphs."""
    global _few
    before, _few = _few, True
    try:
        yield
    finally:
        _few = before


def few() -> bool:
    """Whether operations are to be few."""
    return _few


def stack_columns(columns: Sequence[Tensor]) -> Tensor:
    """A table (..., n) of n columns (...)."""
    return torch.stack(tuple(columns), -1) if _few else torch.stack(tuple(columns)).movedim(0, -1)


def join_columns(tables: Sequence[Tensor]) -> Tensor:
    """Tables (..., n_1), (..., n_2), ... side by side: (..., n_1 + n_2 + ...)."""
    if _few:
        return torch.cat(tuple(tables), -1)
    return torch.cat([table.movedim(-1, 0) for table in tables]).movedim(0, -1)


def split_columns(table: Tensor, *widths: int) -> list[Tensor]:
    """A table (..., n) cut into tables (..., n_1), (..., n_2), ... whose widths add up to n."""
    if _few or not table.requires_grad:  # the same views; their gradients would lie row by row
        return list(table.split(widths, -1))
    return [part.movedim(0, -1) for part in table.movedim(-1, 0).split(widths)]


def columns(table: Tensor) -> tuple[Tensor, ...]:
    """The n columns (...) of a table (..., n)."""
    return table.unbind(-1) if _few or not table.requires_grad else table.movedim(-1, 0).unbind(0)


def by_column(table: Tensor) -> Tensor:
    """A copy of the table (N, n) whose columns are contiguous."""
    return table.new_empty_strided(table.shape, (1, len(table))).copy_(table)


def take_rows(table: Tensor, rows: Tensor) -> Tensor:
    """Rows (M, n) of a table (N, n), column by column."""
    return table.T.index_select(1, rows).T
