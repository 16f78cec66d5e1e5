"""A regression on few of many groups of functions, from sums of products alone.

    w = J a + sum over chosen groups g of  Z_g b_g + e,          b_g ~ N(0, v_g I),    e ~ N(0, s^2 I),    a free

Groups are chosen one at a time (forward selection of groups; Yuan and Lin, Journal of the Royal Statistical Society B
68 (2006), discuss it beside the group lasso), the one with the largest marginal likelihood less a price,

    max over v of  sum_i [ p_i^2 v / (1 + l_i v) - log(1 + l_i v) ] / 2   -   log(B) / 2   -   log(number of groups),

with l_i the eigenvalues of Z_g' Z_g / s^2 free of J and of the groups before, p_i the pull of w along their
eigenvectors, and B blocks of time, the price of v. A group of many fine functions thus pays for what it needs of them,
and not for their number. The variances v_g of all that were chosen then maximise the marginal likelihood together
(MacKay, Neural Computation 4 (1992)). All of it needs only the products of columns, so that leaving rows out is a
subtraction.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import log
from typing import final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

_NEW = 1e-4  # of a column's squared length that must be left beside the others; below, it is one of them
_TURNS, _SETTLED = 40, 0.05  # of the variances, and change of their logarithm that ends them
_GONE = 0.02  # of the noise variance: what a group changes in all rows together, below which it is nothing
_JITTER = 1e-10  # of a correlation, added so that it can be factorised
# prior variances that are tried, in units of that at which a usual function would show as much as noise
_VARIANCES = np.logspace(-3.0, 4.0, 36)[:, None]


@dataclass(frozen=True)
class Products:
    """Sums of products over rows of the columns J, Z and w, in this order.

    Args:
        gram: The products (k + p + 1, k + p + 1).
        rows: Number of rows.
        own: Number k of the columns J.
    """

    gram: Array
    rows: int
    own: int

    def __sub__(self, other: "Products") -> "Products":
        return Products(self.gram - other.gram, self.rows - other.rows, self.own)

    def __add__(self, other: "Products") -> "Products":
        return Products(self.gram + other.gram, self.rows + other.rows, self.own)

    def freed(self) -> Array:
        """Products (p + 1, p + 1) of Z and w without what J can do."""
        k = self.own
        cross = self.gram[:k, k:]
        return np.asarray(self.gram[k:, k:] - cross.T @ _pseudo_inverse(self.gram[:k, :k]) @ cross)

    def parameters(self, weights: Array) -> Array:
        """The parameters a (k,) beside weights of all columns Z (p,)."""
        k = self.own
        return np.asarray(
            _pseudo_inverse(self.gram[:k, :k]) @ (self.gram[:k, -1] - self.gram[:k, k:-1] @ weights)
        )


@dataclass(frozen=True)
class Weights:
    """Weights of the columns Z of chosen groups.

    Args:
        mean: Posterior mean (p,), 0 of columns that were not chosen.
        covariance: Posterior covariance of the columns `at`.
        at: Numbers of the columns of chosen groups.
    """

    mean: Array
    covariance: Array
    at: Labels


@final
class Candidates:
    """Groups of columns to choose from, in folds; products of two groups are made once one of them is chosen.

    Args:
        own: Columns J of each fold (n, k).
        columns: Columns Z of each fold (n, p).
        target: w of each fold (n,).
        members: Columns of Z of each group.
    """

    def __init__(
        self,
        own: Sequence[Array],
        columns: Sequence[Array],
        target: Sequence[Array],
        members: Sequence[Labels],
    ) -> None:
        self.members, self._columns = members, columns
        self.rows = [len(w) for w in target]
        fixed = [np.column_stack((j, w)) for j, w in zip(own, target, strict=True)]
        self._fixed = [f.T @ f for f in fixed]
        self._cross = [z.T @ f for z, f in zip(columns, fixed, strict=True)]
        self._blocks = [[z[:, at].T @ z[:, at] for at in members] for z in columns]
        self._of_group: dict[int, list[Array]] = {}

    def without(self, fold: int, *, blocks: int, most: int, barred: Collection[int] = ()) -> list[int]:
        """Numbers of the groups that explain more than they cost without a fold, in the order in which they are chosen.

        Args:
            fold: Number of the fold left out.
            blocks: Blocks of time.
            most: Most groups.
            barred: Numbers of groups that may not be.
        """
        others = [f for f in range(len(self.rows)) if f != fold]
        rows = sum(self.rows[f] for f in others)
        fixed, cross = (np.sum([part[f] for f in others], 0) for part in (self._fixed, self._cross))
        within = [np.sum([self._blocks[f][g] for f in others], 0) for g in range(len(self.members))]
        chosen, price = list[int](), log(max(len(self.members), 1))
        # beside what there is (J and the groups chosen), whose products are `basis`, with Z `along` and with w `pull`
        basis, along, pull = fixed[:-1, :-1], cross[:, :-1], fixed[:-1, -1]
        while len(chosen) < most:
            inverse = _pseudo_inverse(basis)
            noise = max(float(fixed[-1, -1] - pull @ inverse @ pull), 1e-300) / max(rows, 1)
            rest = cross[:, -1] - along @ (inverse @ pull)
            gains = np.full(len(self.members), -np.inf)
            for g, at in enumerate(self.members):
                if g in chosen or g in barred:
                    continue
                new = within[g] - along[at] @ inverse @ along[at].T
                if (new.diagonal() > _NEW * within[g].diagonal()).any():
                    gains[g] = _evidence(new, rest[at], noise) - 0.5 * log(max(blocks, 2)) - price
            best = int(gains.argmax())
            if not gains[best] > 0:
                break
            at = self.members[best]
            more = np.sum([self._with(best)[f] for f in others], 0)
            basis = np.block([[basis, along[at].T], [along[at], within[best]]])
            along, pull = np.concatenate((along, more), 1), np.append(pull, cross[at, -1])
            chosen.append(best)
        return chosen

    def _with(self, group: int) -> list[Array]:
        """Products of all columns with those of a group, by fold."""
        if group not in self._of_group:
            at = self.members[group]
            self._of_group[group] = [z.T @ z[:, at] for z in self._columns]
        return self._of_group[group]


def weighted(products: Products, members: Sequence[Labels], chosen: Sequence[int]) -> Weights:
    """Weights of chosen groups, their prior variances at the largest marginal likelihood.

    Args:
        products: Of the rows that they are fitted to.
        members: Columns of Z of each group.
        chosen: Numbers of the groups.
    """
    freed = products.freed()
    gram, pull, square = freed[:-1, :-1], freed[:-1, -1], max(float(freed[-1, -1]), 1e-300)
    nothing = Weights(np.zeros(len(pull)), np.zeros((0, 0)), np.zeros(0, dtype=np.int64))
    if not chosen:
        return nothing
    at = np.concatenate([members[g] for g in chosen])
    of = np.repeat(np.arange(len(chosen)), [len(members[g]) for g in chosen])
    gram, pull = gram[np.ix_(at, at)], pull[at]
    size = np.maximum(np.bincount(of, weights=gram.diagonal()), 1e-300)
    noise = square / products.rows
    variance = noise * products.rows / size  # each explains as much as there is
    mean, covariance, live = np.zeros(len(at)), np.zeros((len(at), len(at))), np.arange(len(at))
    for _ in range(_TURNS):
        live = np.flatnonzero(variance[of] > 0)
        if not len(live):
            return nothing
        prior = 1.0 / variance[of[live]]
        precision = gram[np.ix_(live, live)] / noise + np.diag(prior)
        covariance = np.linalg.inv(precision + _JITTER * np.diag(precision.diagonal()))
        mean = covariance @ pull[live] / noise
        shown = 1.0 - prior * covariance.diagonal()
        count = np.bincount(of[live], weights=shown, minlength=len(chosen))
        squares = np.bincount(of[live], weights=mean**2, minlength=len(chosen))
        new = np.where(count > 0, squares / np.maximum(count, 1e-9), 0.0)
        new[new * size < _GONE * noise] = 0.0
        rest = square - 2.0 * float(mean @ pull[live]) + float(mean @ gram[np.ix_(live, live)] @ mean)
        noise = max(rest, 1e-12 * square) / max(products.rows - float(count.sum()), 1.0)
        there = variance > 0
        moved = np.abs(np.log(np.maximum(new[there], 1e-300) / variance[there])).max()
        variance = new
        if moved < _SETTLED:
            break
    out = np.zeros(len(nothing.mean))
    out[at[live]] = mean
    return Weights(out, covariance, at[live])


def _evidence(gram: Array, pull: Array, noise: float) -> float:
    """Gain in the marginal likelihood by a group of functions, at its best prior variance [nats].

    Args:
        gram, pull: Products of its columns with each other (q, q) and with what is to be explained (q,).
        noise: Variance of the noise.
    """
    values, vectors = np.linalg.eigh(gram / noise)
    squares = np.square(vectors.T @ pull / noise)
    variance = _VARIANCES * len(values) / max(float(values.sum()), 1e-300)
    grown = 1.0 + np.maximum(values, 0.0) * variance
    return 0.5 * float((squares * variance / grown - np.log(grown)).sum(1).max())


def _pseudo_inverse(gram: Array) -> Array:
    """Pseudo-inverse of products of columns of any sizes."""
    size = np.sqrt(np.maximum(gram.diagonal(), 0.0))
    scale = np.where(size > 0, 1.0 / np.where(size > 0, size, 1.0), 0.0)
    unit = gram * scale * scale[:, None]
    return np.asarray(np.linalg.pinv(unit, rcond=1e-10, hermitian=True) * scale * scale[:, None])
