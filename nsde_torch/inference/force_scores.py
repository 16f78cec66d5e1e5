"""What the likelihood says of any force on the ports, by one pass backwards: scores, and how they scatter by chance.

With z_k the whitened innovations, L_k L_k' their covariances, and a force f on the step from row k, whose innovations
move by -B f, the gradient of the log likelihood in all forces is that of an adjoint (de Jong and Penzer, Journal of the
American Statistical Association 93 (1998))

    r_k = H' L_k^-T z_k + (I - G H)' F' r_{k+1},        d l / d f_k = B' r_{k+1}

A function phi of anything that was measured has the score s = sum_k phi_k d l / d f_k, orthogonal to what the
parameters can do once it is

    s - I_phi,theta I_theta,theta^-1 s_theta,

whose shared information is the same adjoint of the rows that the parameters move. How a score scatters where nothing is
missing is that of the adjoints of `DRAWS` white rows: of what is known of the noise alone.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.arrays import Array, Labels, Mask
from nsde_torch.inference import kernels
from nsde_torch.inference.estimate import Optimum
from nsde_torch.inference.sensitivity import inverted
from nsde_torch.time_limit import check_time

DRAWS = 96  # draws of white rows: an information is then known to 15 %, and tests allow for that
_ROWS = 40_000  # that are enough: the draws of six ports then take 120 MB
_AT_ONCE = 16  # rows side by side of one pass
_BLOCKS = 60  # of time that are enough: below, chunks are parted
_BLOCK_S = 0.25  # the shortest of them [s]
# without it a damping beside that of the machine has a score of 5 standard errors, of rounding alone
_FREE = 1e-5  # share of a function's effect that the parameters must leave
_NEW = 1e-3  # share of the square of a function that those before it must leave


@dataclass(frozen=True)
class FunctionScores:
    """Scores of some functions of one port, orthogonal to the parameters, by block of time."""

    blocks: Array  # (B, q)
    drawn: Array  # the same of rows that are drawn (B, q, R)
    least: Array  # information that a function must have beside the parameters and those before it (q,)
    draws: int  # how many draws know the information, less those that what was taken out has used up

    @cached_property
    def total(self) -> Array:
        """Their sums (q,)."""
        return np.asarray(self.blocks.sum(0))

    @cached_property
    def information(self) -> Array:
        """Their information, of all blocks (q, q)."""
        drawn = self.drawn.sum(0)
        return np.asarray(drawn @ drawn.T / drawn.shape[1])

    @cached_property
    def informations(self) -> Array:
        """The same by block (B, q, q)."""
        return np.asarray(self.drawn @ self.drawn.transpose(0, 2, 1) / self.drawn.shape[2])

    def of(self, blocks: Mask | Labels) -> "FunctionScores":
        """Those of some blocks of time."""
        return replace(self, blocks=self.blocks[blocks], drawn=self.drawn[blocks])

    def turned(self, turn: Array) -> "FunctionScores":
        """Those of other functions, sums of these (q', q)."""
        return FunctionScores(
            self.blocks @ turn.T, turn @ self.drawn, np.square(turn) @ self.least, self.draws
        )

    def independent(self) -> tuple["FunctionScores", Labels]:
        """The same in directions of unit information, in order, and which functions these begin with (q',)."""
        turn, kept = directions(self.information, self.least)
        return self.turned(turn), kept

    @property
    def nats(self) -> float:
        """Log likelihood that the functions bring; what draws know of the information is counted out."""
        own = self.independent()[0]
        q = own.blocks.shape[1]
        return 0.5 * float(np.square(own.total).sum()) * max(self.draws - q - 1, 1) / self.drawn.shape[2]


def directions(information: Array, least: Array) -> tuple[Array, Labels]:
    """Sums of functions (q', q) whose scores are independent and of unit information, and with which each begins (q',).

    Of functions of some information (q, q), of which `least` (q,) has to be left beside those before.
    """
    turns, kept = list[Array](), list[int]()
    for j in range(len(information)):
        turn = np.zeros(len(information))
        turn[j] = 1.0
        for other in turns:
            turn -= float(other @ information[j]) * other
        left = float(turn @ information @ turn)
        if left > max(_NEW * information[j, j], least[j], 1e-300):
            turns.append(turn / left**0.5)
            kept.append(j)
    return np.array(turns).reshape(len(turns), len(information)), np.array(kept, dtype=np.int64)


@dataclass(frozen=True)
class ForceScores:
    """Scores of forces on each port in each row of each chunk, from the rows of each part of the chunk.

    A force is felt for as long as the filter remembers. Its scores by the time at which it acts are therefore not
    independent of one another, by the rows in which it is seen they are: blocks of time are parts of chunks.
    """

    at: Optimum  # the optimum, in an even part of a long log
    forces: Array  # (d, C, T, parts)
    shared: Array  # information that a force shares with each parameter (d, C, T, k)
    drawn: NDArray[np.float32]  # scores of rows that are drawn (d, C, T, parts * R)
    parameters: Array  # scores of the parameters by block, and those that are drawn (C, parts, k, 1 + R)
    inverse: Array  # of the information of the parameters (k, k)
    columns: Tensor  # what the parameters do to the steps (T, C, ne, k)
    row: Labels  # number of the step of the log that starts at each row (C, T)
    runs: Labels  # number of the run of each chunk (C,)

    def of(self, functions: Array, port: int) -> FunctionScores:
        """Scores of functions of the steps (N, q) on one port, by number of the disturbance."""
        return self.of_rows(functions[self.row], port)

    def of_rows(self, functions: Array, port: int) -> FunctionScores:
        """The same of functions of the rows of each chunk (C, T, q)."""
        there = functions.transpose(0, 2, 1)
        chunks, q, _ = there.shape
        turn = np.einsum("cqt,ctk->qk", there, self.shared[port], optimize=True) @ self.inverse
        blocks = (there @ self.forces[port]).transpose(0, 2, 1)
        drawn = (there.astype(np.float32) @ self.drawn[port]).astype(np.float64)
        drawn = drawn.reshape(chunks, q, -1, DRAWS).transpose(0, 2, 1, 3)
        least = _FREE * np.square(drawn.sum((0, 1))).mean(1)
        blocks = blocks - self.parameters[..., 0] @ turn.T
        drawn = drawn - turn @ self.parameters[..., 1:]
        return FunctionScores(blocks.reshape(-1, q), drawn.reshape(-1, q, DRAWS), least, DRAWS)

    def along(self, port: int, steps: int) -> tuple[Array, Array]:
        """Scores of a force in each of so many steps of the log (N,), and those that are drawn (N, R)."""
        drawn = np.zeros((steps, DRAWS))
        np.add.at(drawn, self.row, self.drawn[port].reshape(*self.row.shape, -1, DRAWS).sum(2))
        own = np.bincount(self.row.ravel(), self.forces[port].sum(2).ravel(), steps)
        return np.asarray(own), drawn

    @property
    def blocks(self) -> Labels:
        """Number of the run of each block of time (B,)."""
        return np.repeat(self.runs, self.forces.shape[3])


def force_scores(at: Optimum) -> ForceScores:
    """Scores of all forces at an optimum; those of the last one are kept."""
    known: ForceScores | None = at.of.scores.of(at)
    if known is None:
        part = at.of.part(_ROWS)
        known = at.of.scores.keep(at, _force_scores(at if part is None else at.some(part)))
    return known


@torch.no_grad()
def _force_scores(at: Optimum) -> ForceScores:
    space, about, here, free = at.of.space, at.about, at.at, at.free
    space.use(at.theta)
    chunks = space.chunks
    columns = space.columns(about.x, about.slopes, free.tolist(), about.after)
    # where the filter has diverged nothing is known (a smoothed cart with play whose declared physics did)
    sound = torch.isfinite(columns).all(-1).all(-1).all(0) & torch.isfinite(here.white).all(-1).all(0)
    if not bool(sound.all()) and bool(sound.any()):
        return _force_scores(at.some(sound.nonzero()[:, 0]))
    acts = space.pushed(about.x, about.slopes, about.after)
    counted = chunks.counted.any(1).nonzero()[:, 0]
    ends = torch.linspace(int(counted[0]), int(counted[-1]) + 1, _parts(at) + 1).round().long().tolist()
    parts = len(ends) - 1

    def back(white: Array) -> tuple[Tensor, Tensor]:
        """Slopes in forces (d, C, T, q) and in parameters (C, k, q) of rows (T, C, m, q)."""
        check_time()
        steps = torch.empty(*chunks.row.shape, space.ne, white.shape[3], dtype=torch.float64)
        read = (about.slopes, at.levels.keep(space.h), space.observed, here.whitening, here.gain)
        kernels.in_parts(kernels.step_adjoints, *chunks.row.shape, *read, chunks.counted, white, steps)
        parameters = torch.einsum("tcik,tciq->ckq", columns, steps)
        forces = acts.transpose(2, 3) @ space.low_passed_rows(steps)
        return forces.permute(2, 1, 0, 3), parameters

    def parted(white: Array) -> Array:
        """Rows (T, C, m, q) as those of each part of the chunks alone (T, C, m, parts * q)."""
        out = np.zeros((*white.shape[:3], parts, white.shape[3]))
        for p, (a, b) in enumerate(pairwise(ends)):
            out[a:b, ..., p, :] = white[a:b]
        return out.reshape(*white.shape[:3], -1)

    moved = _moved(at, columns)
    information = np.einsum("tcmk,tcml->kl", moved, moved)
    inverse = inverted(information) if len(free) else information
    # less what a step of the parameters takes out: blocks are those of a fit that has settled
    white = np.ascontiguousarray(here.white.numpy())
    left = white - moved @ (inverse @ np.einsum("tcmk,tcm->k", moved, white))
    forces, own = back(parted(left[..., None]))
    shared, _ = back(moved)
    drawn = torch.empty(*forces.shape[:3], parts, DRAWS)
    of_draws = []
    rng, at_once = np.random.default_rng(0), max(1, _AT_ONCE // parts)
    for begun in range(0, DRAWS, at_once):
        drawn_rows = rng.standard_normal((*white.shape, min(at_once, DRAWS - begun)))
        scores, parameters = back(parted(drawn_rows))
        of_draws.append(parameters.unflatten(2, (parts, -1)))
        drawn[..., begun : begun + at_once] = scores.unflatten(3, (parts, -1))
    tables = forces.contiguous().numpy(), shared.contiguous().numpy(), drawn.flatten(3).numpy()
    of_parameters = torch.cat([own[..., None], *of_draws], 3).transpose(1, 2).numpy()
    row, runs = chunks.row.T.numpy(), np.array(space.steps.runs)[chunks.stretch.numpy()]
    return ForceScores(at, *tables, of_parameters, inverse, columns, row, runs)


def _parts(at: Optimum) -> int:
    """Into how many blocks of time each chunk is parted."""
    chunks = at.of.space.chunks
    rows = int(chunks.counted.sum(0).max())
    return max(
        1, min(-(-_BLOCKS // chunks.count), int(rows * at.of.space.h / (_BLOCK_S * at.of.space.steps.pace)))
    )


def _moved(at: Optimum, columns: Tensor) -> Array:
    """What parameters do to the whitened rows (T, C, m, k)."""
    space, about, here = at.of.space, at.about, at.at
    rows, count, m = here.white.shape
    k = columns.shape[-1]
    table, none = np.zeros((count, rows, m, k)), np.zeros((rows - 1, count, 0))
    place = np.where(space.chunks.counted[1:].numpy(), np.arange(1, rows)[:, None], -1)
    keep = at.levels.keep(space.h)
    read = (about.slopes[:-1], keep, space.observed, here.gain[:-1], here.whitening[1:], place)
    does = (columns[:-1], none, np.zeros(0, dtype=np.int64), np.zeros((count, space.n, k)))
    kernels.in_parts(kernels.sensitivities, rows - 1, count, *read, *does, 0, table)
    return table.transpose(1, 0, 2, 3)
