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
from functools import reduce
from math import log
from operator import add
from typing import final

import numpy as np
from numpy.typing import NDArray

from nsde_torch.time_limit import check_time

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

_NEW = 1e-4  # of a column's squared length that must be left beside the others; below, it is one of them
_TURNS, _SETTLED = 40, 0.05  # of the variances, and change of their logarithm that ends them
_GONE = 0.02  # of the noise variance: what a group changes in all rows together, below which it is nothing
_JITTER = 1e-10  # of a correlation, added so that it can be factorised
_ROUNDING = 1e-12  # of a squared length: less is not left of it
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

    def of(self, at: Labels) -> "Products":
        """The same of some of the columns Z alone."""
        kept = np.concatenate((np.arange(self.own), self.own + at, [len(self.gram) - 1]))
        return Products(self.gram[np.ix_(kept, kept)], self.rows, self.own)

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
    """Groups of columns to choose from.

    Args:
        products: Of each fold.
        members: Columns of Z of each group.
    """

    def __init__(self, products: Sequence[Products], members: Sequence[Labels]) -> None:
        self.products, self.members = products, members
        widths = np.array([len(at) for at in members], dtype=np.int64)
        alike = [np.flatnonzero(widths == width) for width in np.unique(widths)]
        # groups of one width, which are looked at together, and their columns (G, q)
        self._alike = [(of, np.stack([members[g] for g in of.tolist()])) for of in alike]

    def of(self, groups: Sequence[int]) -> list[Products]:
        """Products of some groups alone, of each fold."""
        at = np.concatenate([np.zeros(0, dtype=np.int64), *(self.members[g] for g in groups)])
        return [part.of(at) for part in self.products]

    def without(self, fold: int, *, blocks: int, most: int, barred: Collection[int] = ()) -> list[int]:
        """Numbers of the groups that explain more than they cost without a fold, in the order in which they are chosen.

        Args:
            fold: Number of the fold left out.
            blocks: Blocks of time.
            most: Most groups.
            barred: Numbers of groups that may not be.
        """
        others = reduce(add, [part for f, part in enumerate(self.products) if f != fold])
        gram, own = others.gram, others.own
        within = [gram[own + at[:, :, None], own + at[:, None, :]] for _, at in self._alike]
        free = np.ones(len(self.members), dtype=bool)
        free[[*barred]] = False
        chosen, price = list[int](), log(max(len(self.members), 1))
        # beside what there is (J and the groups chosen), whose columns are `there`
        there = np.arange(own, dtype=np.int64)
        square = float(gram[-1, -1])
        while square > 0 and len(chosen) < most:
            check_time()
            pull, along = gram[there, -1], gram[own:-1, there]
            inverse = _pseudo_inverse(gram[np.ix_(there, there)])
            noise = max(square - float(pull @ inverse @ pull), _ROUNDING * square) / max(others.rows, 1)
            rest = gram[own:-1, -1] - along @ (inverse @ pull)
            gains = np.full(len(self.members), -np.inf)
            for (of, at), whole in zip(self._alike, within, strict=True):
                new = whole - along[at] @ inverse @ np.swapaxes(along[at], 1, 2)
                sizes, left = (np.diagonal(g, axis1=1, axis2=2) for g in (whole, new))
                live = free[of] & (left > _NEW * sizes).any(1)
                gains[of[live]] = _evidence(new[live], rest[at[live]], noise)
            gains -= 0.5 * log(max(blocks, 2)) + price
            best = int(gains.argmax())
            if not gains[best] > 0:
                break
            there, free[best] = np.append(there, own + self.members[best]), False
            chosen.append(best)
        return chosen


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
        noise = max(rest, _ROUNDING * square) / max(products.rows - float(count.sum()), 1.0)
        there = variance > 0
        moved = np.abs(np.log(np.maximum(new[there], 1e-300) / variance[there])).max()
        variance = new
        if moved < _SETTLED:
            break
    out = np.zeros(len(nothing.mean))
    out[at[live]] = mean
    return Weights(out, covariance, at[live])


def _evidence(gram: Array, pull: Array, noise: float) -> Array:
    """Gain in the marginal likelihood by each of some groups of functions (G,), at its best prior variance [nats].

    Args:
        gram, pull: Products of its columns with each other (G, q, q) and with what is to be explained (G, q).
        noise: Variance of the noise.
    """
    values, vectors = np.linalg.eigh(gram / noise)
    squares = np.square(np.swapaxes(vectors, 1, 2) @ pull[:, :, None] / noise)[:, None, :, 0]
    variance = _VARIANCES * values.shape[1] / np.maximum(values.sum(1), 1e-300)[:, None, None]
    grown = 1.0 + np.maximum(values, 0.0)[:, None] * variance
    return np.asarray(0.5 * (squares * variance / grown - np.log(grown)).sum(2).max(1))


def _pseudo_inverse(gram: Array) -> Array:
    """Pseudo-inverse of products of columns of any sizes."""
    size = np.sqrt(np.maximum(gram.diagonal(), 0.0))
    scale = np.where(size > 0, 1.0 / np.where(size > 0, size, 1.0), 0.0)
    unit = gram * scale * scale[:, None]
    return np.asarray(np.linalg.pinv(unit, rcond=1e-10, hermitian=True) * scale * scale[:, None])
