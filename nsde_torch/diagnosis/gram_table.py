"""What columns explain of blocks of time that they were not fitted to, from one Gram matrix per block.

    gain = 1/2 |e - J d_b|^2 - 1/2 |e - J d_b' - Z a_b|^2        d, a fitted without the fold of block b

All of the selection by the joint likelihood is linear algebra of these matrices: candidates, terms of laws.
"""

from math import log

import numpy as np

from nsde_torch.arrays import Array, Labels
from nsde_torch.inference.sensitivity import KNOWN, Grams, half_squares, solved

# without it a law linear in the speed was fitted beside a viscous damping, whose rounding it explained
_NEW = 0.03  # share of a column that must be left: less is nothing that the physics cannot do already
_SEEN = 1e-9  # share of a column that must be left beside the others for it to be seen
_ROUNDING = 1e-10  # of the largest eigenvalue: directions that columns hardly have


class GramTable:
    """Gram matrices of one pass with the columns of all candidates, and what these explain of folds left out.

    `base` are the columns of the parameters of the physics, `fold` is that of each block.
    """

    def __init__(self, held: Grams, base: Labels, fold: Labels) -> None:
        self._held, self._base = held, base
        self._folds = [np.flatnonzero(fold == f) for f in np.unique(fold)]
        self._before, self._fitted, _ = self._left_out(self._reduced(self._base, 0))
        inner = held.total[np.ix_(base, base)]
        self._others = np.linalg.pinv(inner, rcond=_ROUNDING, hermitian=True)

    def price(self, parameters: int) -> float:
        """What parameters cost (Schwarz) [nats]."""
        return 0.5 * parameters * log(len(self._held.blocks))

    def gain(self, columns: tuple[int, ...], dropped: Labels | None = None) -> tuple[Array, float, Array]:
        """Held-out nats of each block (B,), nats of all rows as fitted, and the step of a candidate's parameters.

        `columns` are that of the shift of its start, 0 where there is none, then those of its parameters; `dropped`
        those of parameters of the physics that it takes the place of.
        """
        base = self._base if dropped is None else np.setdiff1d(self._base, dropped)
        keep = np.concatenate((base, np.array(columns[1:], dtype=np.int64)))
        after, fitted, step = self._left_out(self._reduced(keep, columns[0]))
        return self._before - after, self._fitted - fitted, step[len(base) :]

    def is_new(self, column: int) -> bool:
        """Whether the parameters of the physics cannot do already what a column does."""
        total = self._held.total
        across = total[self._base, column]
        whole = max(float(total[column, column]), 1e-300)
        return float(np.sqrt(max(1.0 - across @ self._others @ across / whole, 0.0))) > _NEW

    def errors(self, own: Labels) -> Array:
        """Standard errors of the parameters of a candidate (q,), all others free; infinite if it moves nothing."""
        total = self._held.total
        inner = total[np.ix_(own, own)]
        across = total[np.ix_(self._base, own)]
        left = inner - across.T @ self._others @ across
        moves = np.diag(left) > _SEEN * np.diag(inner).clip(1e-300)
        inverse = np.linalg.pinv(left, rcond=_ROUNDING, hermitian=True)
        return np.where(moves, np.sqrt(np.diag(inverse).clip(1e-300)), np.inf)

    def errors_alone(self, own: Labels) -> Array:
        """Standard errors of the parameters of a candidate (q,) if all others were known."""
        return np.asarray(1.0 / np.sqrt(self._held.total[own, own].clip(1e-300)))

    def _reduced(self, keep: Labels, shift: int) -> Array:
        """Blocks (B, 1 + q, 1 + q) of the innovations, less the shift of a start, and of some columns."""
        index = np.concatenate(([0], [shift] if shift else [], keep)).astype(np.int64)
        blocks = self._held.blocks[:, index[:, None], index]
        if not shift:
            return blocks
        turn = np.zeros((len(index), 1 + len(keep)))
        turn[0, 0], turn[1, 0] = 1.0, -1.0
        turn[2:, 1:] = np.eye(len(keep))
        return np.asarray(turn.T @ blocks @ turn)

    def _left_out(self, blocks: Array) -> tuple[Array, float, Array]:
        """Half the squares that are left of each block by parameters fitted without its fold, of all, and the step."""
        total, out = blocks.sum(0), np.empty(len(blocks))
        for rows in self._folds:
            rest = total - blocks[rows].sum(0)
            rest[1:, 1:] += KNOWN * total[1:, 1:]
            out[rows] = half_squares(blocks[rows], solved(rest))
        step = solved(total)
        return out, float(half_squares(total[None], step)[0]), step
