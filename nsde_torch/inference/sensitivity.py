"""What parameters do to the innovations, as one Gram matrix per block of time; all tests are linear algebra of these.

With gains held, predicted states move by S and innovations by -H S (Ljung, System Identification, 1999, section 7.A),

    S_{k+1} = F (I - K H) S_k + G_k,      G_k what the parameters do to the step from the state of row k

so that parameters, effects of a catalogue and nuisances are columns of one linear recursion.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TypeAlias

import numpy as np
import torch
from scipy.optimize import lsq_linear
from torch import Tensor

from nsde_torch.arrays import Array, Labels
from nsde_torch.inference import kernels
from nsde_torch.inference.filtering import Linearisation, Pass
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.spread import Spread
from nsde_torch.inference.state_space import StateSpace

_WHOLE = 0.999  # share of the information on a direction that one block may bring, for it to be left out
_RANK = 1e-10
_NUMBERS = 2_000_000  # of whitened rows that are held at once


KNOWN = 1e-3
"""Share of the information on a parameter that holds it at its optimum in every fold.

Without it parameters that one fold alone shows go anywhere in the other ones, and what keeps them passes for thousands
of nats: functions beside a ground effect (blind hexacopter case_000, seed 8124); laws of a wheelchair's speed, as it
starts in few blocks and the others say nothing of how narrow its friction is (tests/diagnosis/test_evidence.py).
"""


@dataclass(frozen=True)
class Grams:
    """Gram matrices of [e, J, nuisances] in whitened rows, by block of time."""

    blocks: Array  # (B, 1 + k + p, 1 + k + p)
    rows: int  # number of whitened rows
    parameters: int  # k

    @cached_property
    def total(self) -> Array:
        """Their sum."""
        return np.asarray(self.blocks.sum(0))

    def step(self, free: Labels, damping: float, low: Array, high: Array) -> Array:
        """Step of Gauss and Newton (damped: Marquardt) of some parameters, numbered from 0, between bounds (q,)."""
        return bounded_step(
            self.total[np.ix_(1 + free, 1 + free)], self.total[1 + free, 0], damping, low, high
        )

    def inflation(self, free: Labels) -> float:
        """How many times the variance of scores over blocks is what white innovations give it, at least 1.

        A parameter that does nothing brings half a nat where innovations are as predicted, and so many times as much
        where they are not.
        """
        at = 1 + free
        if not len(at):
            return 1.0
        score = self.blocks[:, at, 0] - self.blocks[:, at, 0].mean(0)
        inverse = inverted(self.total[np.ix_(at, at)])
        return max(float(np.einsum("br,rs,bs->", score, inverse, score)) / len(at), 1.0)

    def spread(self, free: Labels) -> Spread:
        """Jackknife over blocks (`nsde_torch.inference.spread`) of some parameters at the optimum, nuisances free."""
        size = self.total.shape[0]
        at = np.concatenate((1 + free, np.arange(1 + self.parameters, size)))
        whole = self.total[np.ix_(at, at)]
        scale = 1.0 / np.sqrt(np.diag(whole).clip(1e-300))
        whole = whole * scale * scale[:, None]
        kept = len(free)
        parts, weights = [], []
        for block in self.blocks:
            own = block[np.ix_(at, at)] * scale * scale[:, None]
            left_out = _of_seen_directions(whole - _WHOLE * own)
            parts.append((left_out @ (block[at, 0] * scale))[:kept])
            weights.append((left_out @ own @ left_out)[:kept, :kept])
        sizes = scale[:kept]
        moved, weighed = np.array(parts) * sizes, np.array(weights) * sizes * sizes[:, None]
        factor = self.rows / max(self.rows - len(at), 1)
        return Spread(factor * moved.T @ moved, moved, weighed)


@torch.no_grad()
def grams(
    space: StateSpace,
    levels: Levels,
    about: Linearisation,
    at: Pass,
    columns: Tensor,
    nuisances: Tensor | None = None,
    *,
    forces: Sequence[tuple[int, Tensor]] = (),
    apart: Sequence[slice] = (),
) -> Grams:
    """Gram matrices of a pass.

    Args:
        columns: What k parameters do to the steps (T, C, ne, k) from the states of `about`; single precision does.
        nuisances: Further columns of the whitened rows (T, C, m, p).
        forces: Number of a disturbance, and forces (T, C, q) that act where it does: further columns behind `columns`.
            What they do to the steps (`nsde_torch.inference.filtering.forced`) is as long as the log and as wide as
            the state, and made row by row.
        apart: Rows of the matrix, the last ones, of groups of columns whose products with one another are not asked
            for: they are 0.
    """
    k = columns.shape[-1] + sum(force.shape[-1] for _, force in forces)
    size = 1 + k + (0 if nuisances is None else nuisances.shape[-1])
    head = apart[0].start if apart else size
    sums = at.gain.new_zeros(len(space.chunks.parts), space.chunks.count, size, size)
    for p, some, table in _tables((space, levels, about, at), columns, forces, nuisances):
        own = table.transpose(1, 2)
        sums[p, some, :head] = own[:, :head] @ table
        sums[p, some, head:, :head] = sums[p, some, :head, head:].transpose(1, 2)
        for s in apart:
            sums[p, some, s, s] = own[:, s] @ table[..., s]
    return Grams(space.chunks.blocks(sums), space.measurements, k)


_OfPass: TypeAlias = tuple[StateSpace, Levels, Linearisation, Pass]


@dataclass(frozen=True)
class WhitenedRows:
    """Whitened rows of e and of some columns of a pass, which others are held against."""

    of: _OfPass
    tables: list[Tensor]  # of each block of time (C, rows, 1 + k), in single precision
    sums: Tensor  # their Gram matrices (parts, C, 1 + k, 1 + k)

    def by_step(self) -> tuple[Labels, Array]:
        """Numbers of the steps whose ends are measured (N,), in order, and their rows (N, m, 1 + k)."""
        space, _, about, _ = self.of
        shown, m = _shown(space, about), len(space.observed)
        steps, rows = [], []
        for (first, end), table in zip(space.chunks.parts, self.tables, strict=True):
            own = shown[first:end]
            row, chunk = own.nonzero(as_tuple=True)
            place = own.cumsum(0)[row, chunk] - 1
            steps.append(space.chunks.row[first:end][row, chunk])
            rows.append(table.unflatten(1, (-1, m))[chunk, place])
        order = torch.cat(steps).argsort()
        return torch.cat(steps)[order].numpy(), torch.cat(rows)[order].double().numpy()

    @property
    def blocks(self) -> Array:
        """Gram matrices of e and the columns, by block of time (B, 1 + k, 1 + k)."""
        return self.of[0].chunks.blocks(self.sums)

    @torch.no_grad()
    def beside(self, forces: Sequence[tuple[int, Tensor]]) -> list[tuple[Array, Array]]:
        """Products with the columns of each of some forces, and of these columns with one another.

        By block of time: (B, 1 + k, q) and (B, q, q) of a force with q columns; see `grams`.
        """
        space, _, about, _ = self.of
        ends = np.cumsum([0, *(force.shape[-1] for _, force in forces)]).tolist()
        parts = [slice(a, b) for a, b in pairwise(ends)]
        across = self.sums.new_zeros(*self.sums.shape[:3], ends[-1])
        inner = [self.sums.new_zeros(*self.sums.shape[:2], s.stop - s.start, s.stop - s.start) for s in parts]
        for p, some, table in _tables(self.of, about.slopes[..., :0], forces):
            further = table[..., 1:]
            # in single precision, as these rows are kept: half of the time that functions take on a real log
            across[p, some] = (self.tables[p][some].transpose(1, 2) @ further.float()).double()
            for s, sums in zip(parts, inner, strict=True):
                own = further[..., s]
                sums[p, some] = own.transpose(1, 2) @ own
        whole = space.chunks.blocks(across)
        return [(whole[..., s], space.chunks.blocks(sums)) for s, sums in zip(parts, inner, strict=True)]


@torch.no_grad()
def rows_of(of: _OfPass, columns: Tensor, forces: Sequence[tuple[int, Tensor]]) -> WhitenedRows:
    """Whitened rows of a pass, which are kept; columns and forces are those of `grams`."""
    space, _, about, at = of
    count, size = space.chunks.count, 1 + columns.shape[-1] + sum(force.shape[-1] for _, force in forces)
    lengths = [len(space.observed) * length for length in _lengths(space, _shown(space, about))]
    tables = [torch.empty(count, length, size) for length in lengths]
    sums = at.gain.new_zeros(len(lengths), count, size, size)
    for p, some, table in _tables(of, columns, forces):
        tables[p][some] = table.float()
        sums[p, some] = table.transpose(1, 2) @ table
    return WhitenedRows(of, tables, sums)


def _shown(space: StateSpace, about: Linearisation) -> Tensor:
    """Whether rows count and measure anything (T, C): others are zeros, four of five rows of NanoBench."""
    counted = space.chunks.counted
    return counted if about.measured is None else counted & about.measured.any(-1)


def _lengths(space: StateSpace, shown: Tensor) -> list[int]:
    """Most rows of a chunk that are shown, of each block of time."""
    return [int(shown[a:b].sum(0).max()) for a, b in space.chunks.parts]


def _tables(
    of: _OfPass, columns: Tensor, forces: Sequence[tuple[int, Tensor]], nuisances: Tensor | None = None
) -> Iterator[tuple[int, Tensor, Tensor]]:
    """Whitened rows [e, J, nuisances] that are shown, of each block of time in turn of some chunks at once.

    Number of the block, those of the chunks, and rows of all channels (chunks, rows * m, 1 + k + p), which the next
    overwrites.
    """
    space, levels, about, at = of
    k = columns.shape[-1] + sum(force.shape[-1] for _, force in forces)
    acts = np.array([j for j, force in forces for _ in range(force.shape[-1])], dtype=np.int64)
    m, size = len(space.observed), 1 + k + (0 if nuisances is None else nuisances.shape[-1])
    shown, keep = _shown(space, about), levels.keep(space.h)
    lengths = _lengths(space, shown)
    whole = max(1, m * max(lengths) * size)  # numbers of a chunk
    most = min(space.chunks.count, max(1, _NUMBERS // whole))
    buffer = at.gain.new_empty(most * whole)  # new memory costs as much as what is done in it
    for some in torch.arange(space.chunks.count).split(most):
        count = len(some)
        near, here = (about, at) if count == space.chunks.count else (about.of(some), at.of(some))
        moved = at.gain.new_zeros(count, space.n, k)
        for p, ((first, end), length) in enumerate(zip(space.chunks.parts, lengths, strict=True)):
            own = shown[first:end, some]
            place = torch.where(own, own.cumsum(0) - 1, -1)
            table = buffer[: count * length * m * size].zero_().view(count, length, m, size)
            begun = max(first, 1)
            rows, before = slice(begun, end), slice(begun - 1, end - 1)
            pushed = [force[before, some] for _, force in forces] or [moved.new_zeros(end - begun, count, 0)]
            read = (near.slopes[before], keep, space.observed, here.gain[before], here.whitening[rows])
            does = (columns[before, some].double(), torch.cat(pushed, -1).double(), acts)
            stand = place[begun - first :]
            kernels.in_parts(kernels.sensitivities, end - begun, count, *read, stand, *does, moved, 1, table)
            row, chunk = own.nonzero(as_tuple=True)
            there = place[row, chunk]
            table[chunk, there, :, 0] = here.white[first:end][row, chunk]
            if nuisances is not None:
                table[chunk, there, :, 1 + k :] = nuisances[first:end, some][row, chunk]
            yield p, some, table.flatten(1, 2)


def bounded_step(inner: Array, pull: Array, damping: float, low: Array, high: Array) -> Array:
    """Step (k,) of largest pull @ step - step @ inner @ step / 2 between bounds (k,).

    What a bound stops is done by others as far as they can: without that, steps of correlated parameters that were cut
    one by one led down.

    Args:
        inner: Information (k, k).
        pull: Slope of the log likelihood (k,).
        damping: Marquardt's.
        low, high: The bounds, around 0; what they leave no room stays.
    """
    room = low < high
    if not room.all():
        out = np.zeros(len(pull))
        out[room] = bounded_step(inner[np.ix_(room, room)], pull[room], damping, low[room], high[room])
        return out
    scale = 1.0 / np.sqrt(np.diag(inner).clip(1e-300))
    step = np.asarray(inverted(inner, damping) @ pull)
    if not np.isfinite(step).all() or ((low <= step) & (step <= high)).all():
        return step
    values, vectors = np.linalg.eigh(inner * scale * scale[:, None] + damping * np.eye(len(inner)))
    seen = values > _RANK * values[-1]
    root = np.sqrt(values[seen])
    rows, target = root[:, None] * vectors[:, seen].T, (vectors[:, seen].T @ (pull * scale)) / root
    found = lsq_linear(rows, target, (low / scale, high / scale), method="bvls")
    return np.asarray(found.x * scale)


def solved(gram: Array, weights: Array | None = None) -> Array:
    """Least squares (..., k) from Gram matrices of [e, J] (..., 1 + k, 1 + k), in columns of equal length.

    With weights (..., k) of the squares of the unknowns, if any.
    """
    inner = gram[..., 1:, 1:]
    if weights is not None:
        inner = inner + weights[..., None] * np.eye(inner.shape[-1])
    return np.asarray((inverted(inner) @ gram[..., 1:, :1])[..., 0])


def inverted(inner: Array, damping: float = 0.0) -> Array:
    """Inverses of Gram matrices (..., k, k), of those without full rank in the directions that they have."""
    squares = np.diagonal(inner, axis1=-2, axis2=-1)
    # what no row shows has no direction: of a run that was left out, a scale of 1e150 made rounding 1e270 nats, so that
    # nothing was seen beside numbers of each run
    scale = np.where(squares > 0, 1.0 / np.sqrt(squares.clip(1e-300)), 0.0)
    scale = scale[..., None, :] * scale[..., None]
    return _of_seen_directions(inner * scale + damping * np.eye(inner.shape[-1])) * scale


def _of_seen_directions(unit: Array) -> Array:
    """Inverses of symmetric matrices (..., k, k) in directions whose eigenvalues are above `_RANK` of the largest.

    Where the norms of a matrix and its inverse say that all are, that is the inverse, at a tenth of the time.
    """
    try:
        out = np.linalg.inv(unit)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(unit, rcond=_RANK, hermitian=True))
    norms = [np.abs(values).sum(-1).max(-1, initial=0.0) for values in (unit, out)]
    unseen = ~(norms[0] * norms[1] * _RANK < 1.0)
    if unseen.any():
        out[unseen] = np.linalg.pinv(unit[unseen], rcond=_RANK, hermitian=True)
    return np.asarray(0.5 * (out + out.swapaxes(-1, -2)))


def half_squares(blocks: Array, step: Array) -> Array:
    """Half the squares (...) that steps of the unknowns (..., k) leave of e in blocks (..., 1 + k, 1 + k) [nats]."""
    weights = np.concatenate((np.ones((*step.shape[:-1], 1)), -step), -1)
    return np.asarray(0.5 * (weights[..., None, :] @ blocks @ weights[..., None])[..., 0, 0])
