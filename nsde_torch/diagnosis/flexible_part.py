"""A flexible model of the rows of some ports, on channels that these move: fitted without each fold, judged on it.

    r_c = J_c a + sum over rows p of  m_cp f_p(z) + noise_c

r_c is the residual over a box, a steps of parameters from their optimum (shapes stay), m_cp what a push of 1
on row p changes of channel c, by the machine's own equations.
What is foretold of a fold comes from the other folds alone: parameters, which functions there are, and their weights.
The noise model is that of what is then left (`sysid.noise`), found by turns from two first ones: that of the physics
alone, which has learned what the physics lacks, and one of white pushes and sensors, which has learned nothing.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import chain, groupby, pairwise
from operator import add

import numpy as np
from numpy.typing import NDArray

from nsde_torch.diagnosis.decisions import Budgets
from nsde_torch.diagnosis.evidence import free_basis, stretches
from nsde_torch.diagnosis.fitted import nonlinear
from nsde_torch.diagnosis.group_selection import Candidates, Products, Weights, weighted
from nsde_torch.diagnosis.regressors import Regressors
from nsde_torch.diagnosis.search import Base
from nsde_torch.diagnosis.smooth_functions import FunctionGroup, processes_of_two
from nsde_torch.inference.smooth import Scale
from nsde_torch.sysid.noise import Noise
from nsde_torch.sysid.regression import Regression
from nsde_torch.time_limit import check_time

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

_SETTLED = 1.0  # nats: turns between functions and noise model that bring less have converged
_AT_ONCE = 64  # columns that are whitened together: filters need several times their memory


@dataclass(frozen=True)
class Push:
    """What a push of 1 on a row of a port changes.

    Args:
        row: Name of the row, `body_moment[y]`.
        changes: Of each box, by number of the channel among the rows of the regression (M,).
    """

    row: str
    changes: dict[int, Array]


@dataclass(frozen=True)
class RowTerm:
    """Functions on a row."""

    row: str
    group: FunctionGroup


@dataclass(frozen=True)
class Foretold:
    """What is left of folds that were foretold from the others.

    Args:
        left: Residuals over boxes, by channel (M,).
        noises: Noise models of these, by channel.
        density: Log density of each whitened row, by channel (N,) [nat].
        likelihood: Their sum, less one for each parameter of the noise models.
        weighed_by: Noise models that rows were weighed by.
        chosen: Numbers of the terms in each fold.
    """

    left: dict[int, Array]
    noises: dict[int, Noise]
    density: dict[int, Array]
    likelihood: float
    weighed_by: dict[int, Noise]
    chosen: tuple[tuple[int, ...], ...] = ()

    @property
    def used(self) -> list[int]:
        """Numbers of the terms that some fold chose."""
        return sorted({k for fold in self.chosen for k in fold})


class Part:
    """Rows of ports and the channels that they move.

    Args:
        base: Physics at its optimum, with labels of folds and blocks.
        variables: What its residual may depend on.
        scaled: Scales of the variables.
        groups: Functions to choose from.
        pushes: What moves the channels.
        channels: Numbers of the channels among the rows of the regression.
        budgets: Most terms, and turns.

    Attributes:
        terms: Functions on rows to choose from, which grow by processes of two variables.
    """

    def __init__(
        self,
        base: Base,
        variables: Regressors,
        scaled: dict[str, Scale],
        groups: Sequence[FunctionGroup],
        pushes: Sequence[Push],
        channels: Sequence[int],
        budgets: Budgets,
    ) -> None:
        self.regression, self._variables, self.scaled = base.regression, variables, scaled
        self.pushes, self.channels, self._budgets = {p.row: p for p in pushes}, tuple(channels), budgets
        self._fold = base.fold
        self._blocks = int(base.block.max()) + 1
        self._of_row = _rows_of(base.regression, base.fold)
        self._stretches = stretches(base.fold)
        self._limits = base.regression.carry_limits()
        still = nonlinear(base.regression.vector, smooth=False)  # shapes, in which steps are far from linear
        self._basis = free_basis(base.regression, still)
        self.terms = [RowTerm(p.row, g) for p in pushes for g in groups]
        self._few = len(self.terms) <= budgets.flexible_fine

    def foretold(self) -> tuple[Foretold, Foretold]:
        """What the physics leaves of folds that it was not fitted to, alone and with the flexible model."""
        # one that was fitted to the physics alone has learned what it lacks, and turns may not get away from it
        starts = {c: self.regression.noises[c] for c in self.channels}, self._without_memory()
        plain = best = max(map(self._plain, starts), key=lambda f: f.likelihood)
        for start in starts:
            last, noises = -np.inf, start
            for _ in range(self._budgets.flexible_turns):
                now = self._turn(noises, terms=True)
                if not now.used:
                    break
                self._grow(now)
                best = max(best, now, key=lambda f: f.likelihood)
                if now.likelihood < last + _SETTLED:
                    break
                last, noises = now.likelihood, now.noises
        if best.used:  # what its noise models do for the physics alone is not the functions' doing
            again = (self._plain(best.weighed_by), self._plain(best.noises))
            plain = max(plain, *again, key=lambda f: f.likelihood)
            best = self._where_chosen(plain, best)
        return plain, best if best.likelihood > plain.likelihood else plain

    def _where_chosen(self, plain: Foretold, found: Foretold) -> Foretold:
        """The flexible model in folds for which functions were chosen, and the physics alone in the others."""
        chosen = np.array([bool(fold) for fold in found.chosen])
        rows, white = chosen[self._of_row], chosen[self._fold]
        density = {c: np.where(white, found.density[c], plain.density[c]) for c in self.channels}
        gain = sum(float((density[c] - plain.density[c]).sum()) for c in self.channels)
        left = {c: np.where(rows, found.left[c], plain.left[c]) for c in self.channels}
        return replace(found, left=left, density=density, likelihood=plain.likelihood + gain)

    def _plain(self, noises: dict[int, Noise]) -> Foretold:
        """The physics alone, by turns from some noise models."""
        best = self._turn(noises, terms=False)
        for _ in range(self._budgets.flexible_turns - 1):
            now = self._turn(best.noises, terms=False)
            if now.likelihood < best.likelihood + _SETTLED:
                break
            best = now
        return best

    def products(self, noises: dict[int, Noise], at: Sequence[int]) -> Products:
        """Products over all rows of parameters, the terms `at` and the residual."""
        return reduce(add, self._products(noises, at))

    def members(self, at: Sequence[int]) -> list[Labels]:
        """Columns of each of some terms, one after another."""
        ends = np.cumsum([0, *(self.terms[k].group.width for k in at)])
        return [np.arange(a, b, dtype=np.int64) for a, b in pairwise(ends)]

    def without(self, found: Foretold, which: Sequence[tuple[str, str]]) -> list[float]:
        """Log-likelihood of folds without functions of a variable on a row, others chosen in their place [nats].

        Args:
            found: The flexible model.
            which: Names of variables and rows, one after another.
        """
        candidates = self._candidates(found.noises)
        out = []
        for variable, row in which:
            of_it = {k for k, t in enumerate(self.terms) if variable in t.group.variables and t.row == row}
            chosen = self._chosen(candidates, of_it)
            out.append(self._judged(found.noises, chosen, candidates, found.noises).likelihood)
        return out

    def again(self, found: Foretold) -> float:
        """Log-likelihood of folds with the terms that were chosen, under the noise that they leave [nats]."""
        return self._judged(found.noises, found.chosen, fixed=found.noises).likelihood

    # ---- pieces ---------------------------------------------------------------------------------------

    def _without_memory(self) -> dict[int, Noise]:
        """Noise models of white pushes and sensors, which have learned nothing that lasts."""
        return {
            c: self._law(c, self.regression.residual[:, self.regression.rows[c]], orders=0)
            for c in self.channels
        }

    def _turn(self, noises: dict[int, Noise], *, terms: bool) -> Foretold:
        """Choose functions without each fold under some noise models, and judge them on it."""
        if not terms:
            return self._judged(noises, ((),) * (int(self._fold.max()) + 1))
        candidates = self._candidates(noises)
        return self._judged(noises, self._chosen(candidates), candidates)

    def _candidates(self, noises: dict[int, Noise]) -> Candidates:
        """All terms under some noise models."""
        every = range(len(self.terms))
        return Candidates(self._products(noises, every), self.members(every))

    def _chosen(self, among: Candidates, barred: Collection[int] = ()) -> tuple[tuple[int, ...], ...]:
        """Numbers of the terms that are chosen without each fold, of all but those that are barred."""
        most, folds = self._budgets.flexible_terms, range(len(among.products))
        return tuple(tuple(among.without(f, blocks=self._blocks, most=most, barred=barred)) for f in folds)

    def _judged(
        self,
        noises: dict[int, Noise],
        chosen: tuple[tuple[int, ...], ...],
        among: Candidates | None = None,
        fixed: dict[int, Noise] | None = None,
    ) -> Foretold:
        """Fit chosen terms without each fold and judge them on it.

        Args:
            noises: Noise models that weigh rows.
            chosen: Numbers of the terms, by fold left out.
            among: All terms under these noise models, where they are at hand.
            fixed: Noise models to judge by; None estimates those of what is left.
        """
        at = sorted({k for fold in chosen for k in fold})
        parts, members = self._products(noises, at) if among is None else among.of(at), self.members(at)
        whole, place = reduce(add, parts), {k: j for j, k in enumerate(at)}
        weights: list[Weights] = []
        parameters: list[Array] = []
        for part, fold in zip(parts, chosen, strict=True):
            others = whole - part
            found = weighted(others, members, [place[k] for k in fold])
            weights.append(found)
            parameters.append(others.parameters(found.mean))
        r = self.regression
        left, density, models, likelihood = {}, {}, {}, 0.0
        for c in self.channels:
            columns = self._columns(c, at)
            jacobian, rest = self._jacobian(c), r.residual[:, r.rows[c]].copy()
            for f, (own, found) in enumerate(zip(parameters, weights, strict=True)):
                rows = self._of_row == f
                rest[rows] -= jacobian[rows] @ own + columns[rows] @ found.mean
            law = self._law(c, rest) if fixed is None else fixed[c]
            white = r.whitened(law, rest[:, None])[:, 0]
            size = np.sqrt(np.square(white).sum() / len(rest)) if fixed is None else 1.0
            density[c] = law.log_density(white / size, r.series) - np.log(size)
            left[c], models[c] = rest, law
            likelihood += float(density[c].sum()) - law.parameters
        return Foretold(left, models, density, likelihood, noises, chosen)

    def _law(self, c: int, left: Array, *, orders: int | None = None) -> Noise:
        r, channel = self.regression, self.regression.rows[c]
        return r.law(channel, left, float(self._limits[channel]), r.orders if orders is None else orders)

    def _jacobian(self, c: int) -> Array:
        """What unit steps of parameters change in a channel (M, k), in directions that the data show."""
        r = self.regression
        return np.asarray(r.jacobian[:, r.rows[c]] @ self._basis)

    def _columns(self, c: int, at: Sequence[int]) -> Array:
        """What unit weights of some terms change in a channel (M, p)."""
        boxes = len(self.regression.series)
        parts = []
        for k in at:
            term = self.terms[k]
            change = self.pushes[term.row].changes.get(c)
            own = np.zeros((boxes, 1)) if change is None else change[:, None]
            parts.append(term.group.columns * own)
        return np.concatenate(parts, 1) if parts else np.zeros((boxes, 0))

    def _products(self, noises: dict[int, Noise], at: Sequence[int]) -> list[Products]:
        """Products of parameters, some terms and the residual, fold by fold."""
        own, members = self._basis.shape[1], self.members(at)
        width = own + sum(map(len, members)) + 1
        grams = np.zeros((int(self._fold.max()) + 1, width, width))
        for c in self.channels:
            moved = [i for i, k in enumerate(at) if c in self.pushes[self.terms[k].row].changes]
            places = np.concatenate((np.arange(own), *(own + members[i] for i in moved), [width - 1]))
            white = self._whitened(c, noises[c], [at[i] for i in moved], len(places))
            for f, a, b in self._stretches:
                part = white[a:b]
                if len(places) == width:
                    grams[f] += part.T @ part
                else:
                    grams[f][np.ix_(places, places)] += part.T @ part
            del part, white  # before those of the next channel are made
        rows = np.bincount(self._fold) * len(self.channels)
        return [Products(gram, int(n), own) for gram, n in zip(grams, rows, strict=True)]

    def _whitened(self, c: int, noise: Noise, at: Sequence[int], width: int) -> Array:
        """Slopes, columns of some terms and the residual in a channel (N, width), which holds them all but once."""
        r = self.regression
        terms = (self._columns(c, some) for some in self._batches(at))
        out = np.empty((len(self._fold), width), order="F")
        done = 0
        for part in chain((self._jacobian(c),), terms, (r.residual[:, [r.rows[c]]],)):
            check_time()
            out[:, done : done + part.shape[1]] = r.whitened(noise, part)
            done += part.shape[1]
        return out

    def _batches(self, at: Sequence[int]) -> Iterator[Sequence[int]]:
        """Some terms, a few columns at a time."""
        place = np.cumsum([self.terms[k].group.width for k in at]) // _AT_ONCE
        for _, some in groupby(range(len(at)), key=place.__getitem__):
            yield [at[i] for i in some]

    def _grow(self, found: Foretold) -> None:
        """Add processes of two variables where their polynomial was chosen; of many functions, none that vary."""
        have = {(t.row, t.group.variables, t.group.kind) for t in self.terms}
        for k in found.used:
            row, of = self.terms[k].row, self.terms[k].group.variables
            if len(of) == 2 and not {(row, of, "smooth"), (row, of[::-1], "smooth")} & have:
                new = processes_of_two((of[0], of[1]), self._variables.columns, self.scaled)
                new = new if self._few else new[:1]
                self.terms += [RowTerm(row, group) for group in new]
                have |= {(row, group.variables, group.kind) for group in new}


def _rows_of(regression: Regression, fold: Labels) -> Labels:
    """Fold of each row of the series, from those of whitened rows."""
    out = np.empty(len(regression.series), dtype=np.int64)
    numbers = regression.whitened_rows(np.arange(len(regression.series), dtype=np.int64))
    out[numbers] = fold
    return out
