"""Machines followed through positions: a state observer with the physics in it, on pieces of runs side by side.

    foretold (p, v) = physics over a step from the estimate before,   e = q - p
    p <- p + alpha e,   v <- v + beta e / h                           (`nsde_torch.data.tracking`)

The physics is integrated by the classical Runge-Kutta method: over a step of 10 ms the midpoint rule is wrong by half a
percent of what a fast joint does, which inferred rates and parameters take over.
"""

import copy
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.data import Run
from nsde_torch.data.system_info import rate_pairs
from nsde_torch.data.tracking import SLOWEST_S, AlphaBeta, gains
from nsde_torch.errors import DataError
from nsde_torch.inference.memory import memory_along
from nsde_torch.inference.steps import MOST, RUN_IN_S, RUN_IN_SHARE, steps_of
from nsde_torch.systems import System

Array = NDArray[np.float64]

_GAINS = 8  # that are tried
_BEFORE_S = 10.0 * SLOWEST_S  # before each piece; after it its start is forgotten
_FIRST = 30  # rows after a start that do not judge


class Observer:
    """Pieces of runs, followed side by side.

    Args:
        system: The machine; it is copied.
        runs: Recordings, all on one step, with first guesses of the rates.
        columns: Columns of rates that were inferred from positions.
        dt: The step [s].
        piece_s: Length of a piece [s].
        slowest: Longest time constant of the gains that are tried [s].

    Attributes:
        system: The copy, whose values may be changed between calls.
        positions, rates: Columns of the positions and rates that are followed (m,).
        pieces: Run, first row, end, and row from which on it is followed, of each piece.
        own: Rows of the pieces themselves (rows, pieces).
        judged: Those of them that are far enough from a start; all where none are.
        share: Share of them that are.
        spread: Standard deviation of each rate that physics is averaged over (m,), by Gauss and Hermite's rule of three
            points; nothing at first.
    """

    def __init__(
        self,
        system: System,
        runs: Sequence[Run],
        *,
        columns: Sequence[int],
        dt: float,
        piece_s: float,
        slowest: float = SLOWEST_S,
    ) -> None:
        self.system, self._dt, self._slowest = copy.deepcopy(system).double(), dt, slowest
        self.system.set_step(dt)
        pairs = [(i, j) for i, j in rate_pairs(self.system) if j in columns]
        self.positions, self.rates = [i for i, _ in pairs], [j for _, j in pairs]
        self.spread = np.zeros(len(pairs))
        length, before = max(1, round(piece_s / dt)), round(_BEFORE_S / dt)
        stretches = [(n, a, b) for n, run in enumerate(runs) for a, b in run.segments]
        self.pieces = [
            (n, c, min(c + length, b), max(a, c - before))
            for n, a, b in stretches
            for c in range(a, b, length)
        ]
        parts = [-(-(b - a) // length) for _, a, b in stretches]  # pieces of each
        count = max(end - start for _, _, end, start in self.pieces)
        rows = np.arange(count)[:, None] + np.array([start for *_, start in self.pieces])
        first, end = (np.array([p[k] for p in self.pieces]) for k in (1, 2))
        self.own = (rows >= first) & (rows < end)
        self._memory = None
        if self.system.nz > self.system.nx:
            begun = np.array([start for *_, start in self.pieces])
            self._memory = _Memory(
                self.system, runs, stretches, np.repeat(np.arange(len(parts)), parts), begun, dt
            )
        late = self.own & (np.arange(count)[:, None] >= _FIRST)
        if self._memory is not None:
            late &= rows >= self._memory.known
        self.judged, self.share = (late if late.any() else self.own), float(late.sum() / self.own.sum())
        rows = np.minimum(rows, end - 1)
        of = [runs[n] for n, *_ in self.pieces]
        self._t, self._x, self._u = (
            torch.from_numpy(np.stack([part[rows[:, p]] for p, part in enumerate(parts)], 1))
            for parts in ([run.t for run in of], [run.x for run in of], [run.u for run in of])
        )

    def follow(self, tried: Sequence[Sequence[AlphaBeta]]) -> tuple[Array, Array]:
        """Rates and errors e of all rows, (trials, rows, pieces, m) each.

        Args:
            tried: Gains of each rate, for each trial.
        """
        many, trials = len(self.pieces), len(tried)
        alpha, beta = (
            torch.tensor([[getattr(g, key) for g in gs] for gs in tried], dtype=torch.float64)
            for key in ("alpha", "beta")
        )
        alpha, beta = alpha.repeat_interleave(many, 0), beta.repeat_interleave(many, 0)
        rates, errors = [], []
        with torch.no_grad():
            z = self.system.augment(self._x[0], self._u[0])
            if self._memory is not None:
                z[:, self.system.nx :] = self._memory.now()
            z = z.repeat(trials, 1)
            for t, x, u in zip(self._t, self._x, self._u, strict=True):
                seen = x.repeat(trials, 1)
                e = seen[:, self.positions] - z[:, self.positions]
                now = torch.cat((seen, z[:, self.system.nx :]), 1)
                now[:, self.positions] = z[:, self.positions] + alpha * e
                now[:, self.rates] = z[:, self.rates] + beta * e / self._dt
                rates.append(now[:, self.rates])
                errors.append(e)
                z = self._later(t.repeat(trials), now, u.repeat(trials, 1))
        shape = (len(rates), trials, many, len(self.rates))
        v, e = (torch.stack(p).view(shape).transpose(0, 1).numpy() for p in (rates, errors))
        return v, e

    def best(self) -> tuple[list[AlphaBeta], Array, Array]:
        """Gains of the smallest errors of each rate, their mean squares (m,), and the rates (rows, pieces, m)."""
        tried, m = gains(self._dt, _GAINS, slowest=self._slowest), len(self.rates)
        v, e = self.follow([[g] * m for g in tried])
        with np.errstate(over="ignore"):  # the errors of gains that diverge are infinite, and lose
            square = np.nan_to_num(np.square(e[:, self.judged]), nan=np.inf).mean(1)
        best = square.argmin(0)
        rates = np.stack([v[g, :, :, c] for c, g in enumerate(best)], -1)
        return [tried[g] for g in best], square[best, np.arange(m)], rates

    def _later(self, t: Tensor, z: Tensor, u: Tensor) -> Tensor:
        """States (N, nz) a step later."""
        system, h = self.system, self._dt
        f1 = self._rate(t, z, u)
        f2 = self._rate(t + 0.5 * h, system.inner(z, z + 0.5 * h * f1), u)
        f3 = self._rate(t + 0.5 * h, system.inner(z, z + 0.5 * h * f2), u)
        f4 = self._rate(t + h, system.inner(z, z + h * f3), u)
        return z + (h / 6.0) * (f1 + 2.0 * f2 + 2.0 * f3 + f4)

    def _rate(self, t: Tensor, z: Tensor, u: Tensor) -> Tensor:
        """f at states (N, nz), averaged over `spread`."""
        aside = [(j, by) for j, by in zip(self.rates, self.spread.tolist(), strict=True) if by > 0]
        if not aside:
            return self.system.drift(t, z, u)
        count = 1 + 2 * len(aside)
        points = z.repeat(count, 1).view(count, *z.shape)
        for k, (j, by) in enumerate(aside):
            points[2 * k + 1, :, j] += by * 3.0**0.5
            points[2 * k + 2, :, j] -= by * 3.0**0.5
        f = self.system.drift(t.repeat(count), points.view(-1, z.shape[1]), u.repeat(count, 1)).view(
            points.shape
        )
        return f[0] + (f[1:] - f[0]).sum(0) / 6.0


class _Memory:
    """What effects remember where pieces begin, along the states as they were read: a lag may last longer than a piece.

    Args:
        system: The machine, whose values may be changed between calls.
        runs: Recordings, all on one step.
        stretches: Run, first row and end of each.
        of: Number of the stretch of each piece.
        begun: Row from which on each piece is followed.
        dt: The step [s].

    Attributes:
        known: First row from which a memory that began at rest counts, of each piece.
    """

    def __init__(
        self,
        system: System,
        runs: Sequence[Run],
        stretches: Sequence[tuple[int, int, int]],
        of: NDArray[np.int64],
        begun: NDArray[np.int64],
        dt: float,
    ) -> None:
        self._system = system
        self._steps = steps_of(system, runs, clock=dt / runs[0].dt, smooth=False, differences=0, run_in=False)
        steps = np.array([first for first, _ in self._steps.segments])
        if len(steps) != len(stretches):
            raise DataError(
                f"rates of {len(runs)} runs cannot be inferred beside effects with memory: give less than {MOST} rows."
            )
        first, end = (np.array([stretch[k] for stretch in stretches]) for k in (1, 2))
        run_in = np.minimum(round(RUN_IN_S / dt), (RUN_IN_SHARE * (end - first)).astype(np.int64))
        self.known = (first + run_in)[of]
        self._at = torch.from_numpy(steps[of] + np.minimum(begun - first[of], (end - first)[of] - 2))

    def now(self) -> Tensor:
        """Memory where each piece begins (pieces, nz - nx)."""
        return memory_along(self._system, self._steps)[0][self._at]
