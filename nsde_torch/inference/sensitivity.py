"""What parameters do to the innovations, as one Gram matrix per block of time; all tests are linear algebra of these.

With gains held, predicted states move by S and innovations by -H S (Ljung, System Identification, 1999, section 7.A),

    S_{k+1} = F (I - K H) S_k + G_k,      G_k what the parameters do to the step from the state of row k

so that parameters, effects of a catalogue and nuisances are columns of one linear recursion.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import lsq_linear
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.inference import kernels
from nsde_torch.inference.filtering import Linearisation, Pass
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.spread import Spread
from nsde_torch.inference.state_space import StateSpace

_WHOLE = 0.999  # share of the information on a direction that one block may bring, for it to be left out
_RANK = 1e-10
_NUMBERS = 2_000_000  # of whitened rows that are held at once


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

    def step(self, free: NDArray[np.int64], damping: float, low: Array, high: Array) -> Array:
        """Step of Gauss and Newton (damped: Marquardt) of some parameters, numbered from 0, between bounds (q,)."""
        return bounded_step(
            self.total[np.ix_(1 + free, 1 + free)], self.total[1 + free, 0], damping, low, high
        )

    def inflation(self, free: NDArray[np.int64]) -> float:
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

    def spread(self, free: NDArray[np.int64]) -> Spread:
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
            left_out = np.linalg.pinv(whole - _WHOLE * own, rcond=_RANK, hermitian=True)
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
    chunks = space.chunks
    k = columns.shape[-1] + sum(force.shape[-1] for _, force in forces)
    size = 1 + k + (0 if nuisances is None else nuisances.shape[-1])
    sums = at.gain.new_zeros(len(chunks.parts), chunks.count, size, size)
    longest = max(b - a for a, b in chunks.parts)
    most = max(1, _NUMBERS // (longest * len(space.observed) * size))
    buffer = at.gain.new_empty(min(most, chunks.count), longest, len(space.observed), size)
    for some in torch.arange(chunks.count).split(most):
        extra = None if nuisances is None else nuisances[:, some]
        pushed = [(j, force[:, some]) for j, force in forces]
        near, here = (about, at) if len(some) == chunks.count else (about.of(some), at.of(some))
        tables = _tables(space, levels, near, here, columns[:, some], pushed, extra, some, buffer)
        for p, table in enumerate(tables):
            flat = table.flatten(1, 2)
            own, head = flat.transpose(1, 2), apart[0].start if apart else size
            sums[p, some, :head] = own[:, :head] @ flat
            sums[p, some, head:, :head] = sums[p, some, :head, head:].transpose(1, 2)
            for s in apart:
                sums[p, some, s, s] = own[:, s] @ flat[..., s]
    return Grams(chunks.blocks(sums), space.measurements, k)


def _tables(
    space: StateSpace,
    levels: Levels,
    about: Linearisation,
    at: Pass,
    columns: Tensor,
    forces: Sequence[tuple[int, Tensor]],
    nuisances: Tensor | None,
    some: Tensor,
    buffer: Tensor,
) -> Iterator[Tensor]:
    """Whitened rows [e, J, nuisances] of each block of some chunks (chunks, rows, m, ...), 0 if not counted."""
    k = columns.shape[-1] + sum(force.shape[-1] for _, force in forces)
    acts = np.array([j for j, force in forces for _ in range(force.shape[-1])], dtype=np.int64)
    counted = space.chunks.counted[:, some]
    keep = levels.keep(space.h)
    moved = at.gain.new_zeros(len(some), space.n, k)
    for first, end in space.chunks.parts:
        begun = max(first, 1)
        table = buffer[: len(some), : end - first]  # new memory costs as much as what is done in it
        table[:, : begun - first] = 0.0
        rows, before = slice(begun, end), slice(begun - 1, end - 1)
        pushed = [force[before] for _, force in forces] or [moved.new_zeros(end - begun, len(some), 0)]
        filled = moved.new_empty(len(some), end - begun, len(space.observed), k)
        read = (
            about.slopes[before],
            keep,
            space.observed,
            at.gain[before],
            at.whitening[rows],
            counted[rows],
        )
        does = (columns[before].double(), torch.cat(pushed, -1).double(), acts)
        kernels.in_parts(kernels.sensitivities, end - begun, len(some), *read, *does, moved, filled)
        table[:, begun - first :, :, 1 : 1 + k] = filled
        shown = counted[first:end, :, None]
        table[..., 0] = (at.white[first:end] * shown).transpose(0, 1)
        if nuisances is not None:
            table[..., 1 + k :] = (nuisances[first:end] * shown[..., None]).transpose(0, 1)
        yield table


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
    found = lsq_linear(
        root[:, None] * vectors[:, seen].T,
        (vectors[:, seen].T @ (pull * scale)) / root,
        (low / scale, high / scale),
        method="bvls",
    )
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
    scale = 1.0 / np.sqrt(np.diagonal(inner, axis1=-2, axis2=-1).clip(1e-300))
    scale = scale[..., None, :] * scale[..., None]
    unit = inner * scale + damping * np.eye(inner.shape[-1])
    return np.asarray(np.linalg.pinv(unit, rcond=_RANK, hermitian=True) * scale)


def half_squares(blocks: Array, step: Array) -> Array:
    """Half the squares (...) that steps of the unknowns (..., k) leave of e in blocks (..., 1 + k, 1 + k) [nats]."""
    weights = np.concatenate((np.ones((*step.shape[:-1], 1)), -step), -1)
    return np.asarray(0.5 * (weights[..., None, :] @ blocks @ weights[..., None])[..., 0, 0])
