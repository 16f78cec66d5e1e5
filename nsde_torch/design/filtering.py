"""Log-likelihood of runs by an extended Kalman filter, and the parameters that make it largest.

    z_{k+1} = F(z_k, u_k; theta) + w_k,     measured_k = x_k + s_k,     w_k and s_k white

The regression of a diagnosis evaluates physics at measured states; where an experiment holds a machine still, the
noise of a velocity is as large as the speeds at which friction sets in, and no correction of second order undoes that.
A filter knows the state better than its sensors do (Jazwinski, Stochastic Processes and Filtering Theory, 1970).
Parameters are found by Gauss and Newton's steps on the whitened innovations, with what other runs say of them as a
quadratic. Slopes are differences, all of them in one batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.data import Run
from nsde_torch.design.noises import Noises
from nsde_torch.design.rollout import Rollouts
from nsde_torch.systems import System

Array = NDArray[np.float64]
_SMALL = 1e-5  # of a parameter's size
_SMALL_STATE = 1e-6  # of a state's
_ROUNDS = 8
_SETTLED = 0.02  # nats that a step promises
_ROOM = 1e-10


@dataclass(frozen=True)
class FilterProblem:
    """Runs whose parameters are looked for.

    Args:
        states: Measured states of each run, (n, nx).
        inputs: Inputs held from each row to the next, (n - 1, nu).
        centre: Where other runs say that the parameters are (k,).
        information: How surely (k, k).
    """

    states: tuple[Array, ...]
    inputs: tuple[Array, ...]
    centre: Array
    information: Array


@dataclass(frozen=True)
class FilterFit:
    """The optimum of a problem.

    Args:
        theta: Parameters (k,).
        nats: Log-likelihood of the runs and of where other runs say the parameters are [nats].
        information: Of the runs of the problem and of the others (k, k).
        excess: Mean square of whitened innovations: 1 where noise is what it was taken for.
        moved: How far the parameters are from what other runs say [standard errors of these].
    """

    theta: Array
    nats: float
    information: Array
    excess: float
    moved: float


@dataclass(frozen=True)
class _Look:
    """A problem at some parameters: cost, pull, information, squares of innovations, their number, how far it moved."""

    cost: float
    pull: Array
    info: Array
    square: float
    count: int
    moved: float


@final
class Filter:
    """Filters runs of one system.

    Args:
        system: Physics.
        dt: Step [s].
        noise: Variances.
    """

    def __init__(self, system: System, *, dt: float, noise: Noises) -> None:
        self.rollouts = Rollouts(system, dt=dt)
        self.vector, self._nx = self.rollouts.vector, system.nx
        nz = self.vector.system.nz
        self._q = torch.diag(torch.as_tensor(np.append(noise.pushes, np.zeros(nz - self._nx))))
        self._r = torch.diag(torch.as_tensor(noise.sensors))
        self._start = torch.zeros(nz, nz, dtype=torch.float64)
        self._start[: self._nx, : self._nx] = self._r

    @torch.no_grad()
    def innovations(
        self, thetas: Array, states: Sequence[Array], inputs: Sequence[Array], *, shared: int = 1
    ) -> tuple[Array, Array]:
        """Whitened innovations (B, N, nx), zero behind the end of a run, and sums of log determinants (B,).

        Args:
            thetas: Parameters of each (B, k).
            states: Measured states of each (n, nx).
            inputs: Inputs of each (n - 1, nu).
            shared: Number of neighbours that are filtered with the gains of the first of them; 1: each with its own.
        """
        system, nx = self.vector.system, self._nx
        longest = max(len(u) for u in inputs)
        seen = torch.as_tensor(np.stack([_padded(x, longest + 1) for x in states]))
        u = torch.as_tensor(np.stack([_padded(v, longest) for v in inputs]))
        live = torch.as_tensor(np.arange(longest) < np.array([[len(v)] for v in inputs]))
        theta, b = torch.as_tensor(thetas), len(thetas)
        z = self.rollouts.begin(theta, seen[:, 0], u[:, 0])
        p = self._start.expand(b // shared, -1, -1)
        eye = torch.eye(z.shape[1], dtype=z.dtype)
        white, dets = [], torch.zeros(b, dtype=z.dtype)
        for k in range(longest):
            z, slope = self._predict(theta, k, z, u[:, k], shared)
            p = slope @ p @ slope.mT + self._q
            s = p[:, :nx, :nx] + self._r
            low, info = torch.linalg.cholesky_ex(s)
            new = (seen[:, k + 1] - z[:, :nx]).reshape(len(p), shared, nx).mT
            w = torch.linalg.solve_triangular(low, new, upper=False).mT.reshape(b, nx)
            gain = torch.cholesky_solve(p[:, :nx, :], low).mT
            z = system.project(z + (gain @ new).mT.reshape(b, -1))
            keep = eye - torch.nn.functional.pad(gain, (0, eye.shape[0] - nx))
            p = keep @ p @ keep.mT + gain @ self._r @ gain.mT
            on = live[:, k] & (info == 0).repeat_interleave(shared)
            white.append(torch.where(on[:, None], w, 0.0))
            logs = low.diagonal(dim1=1, dim2=2).log().sum(1).repeat_interleave(shared)
            dets = dets + torch.where(on, logs, 0.0)
        return torch.stack(white, 1).numpy(), dets.numpy()

    def solve(self, problems: Sequence[FilterProblem], rounds: int = _ROUNDS) -> list[FilterFit]:
        """The most likely parameters of each problem.

        Args:
            problems: The problems.
            rounds: Largest number of steps.
        """
        k, v, n = len(self.vector), self.vector, len(problems)
        theta = np.stack([v.inside(q.centre) for q in problems])
        best_cost, damp = np.full(n, np.inf), np.ones(n)
        best = [(t, _Look(np.inf, np.zeros(k), np.eye(k), 0.0, 1, 0.0)) for t in theta]
        done = np.zeros(n, dtype=bool)
        for _ in range(rounds):
            todo = np.flatnonzero(~done).tolist()
            if not todo:
                break
            for i, look in zip(todo, self._looked([problems[i] for i in todo], theta[todo]), strict=True):
                if not look.cost <= best_cost[i] + 1e-9:  # too far: half the way back
                    damp[i] *= 0.3
                    done[i] = damp[i] < 0.01
                else:
                    best_cost[i], best[i], damp[i] = look.cost, (theta[i].copy(), look), 1.0
                at, look = best[i]
                step = _bounded(look.pull, look.info, at, v.inside)
                done[i] |= 0.5 * float(step @ look.info @ step) < _SETTLED
                theta[i] = v.inside(at + damp[i] * step)
        return [
            FilterFit(t, -look.cost, look.info, look.square / max(look.count, 1), look.moved)
            for t, look in best
        ]

    def foreseen(self, problems: Sequence[FilterProblem]) -> list[tuple[float, Array]]:
        """What a refit leaves of runs without noise: half the square of the innovations after one step from the centre
        of each problem, with the price of the step [nats]; and the information of the runs and of the others (k, k)."""
        out = []
        centres = np.stack([q.centre for q in problems])
        for q, look in zip(problems, self._looked(problems, centres), strict=True):
            step = _bounded(look.pull, look.info, q.centre, self.vector.inside)
            gain = float(look.pull @ step - 0.5 * step @ look.info @ step)
            out.append((0.5 * look.square - gain, look.info))
        return out

    # ---- pieces ---------------------------------------------------------------------------------------

    def _predict(self, theta: Tensor, k: int, z: Tensor, u: Tensor, shared: int) -> tuple[Tensor, Tensor]:
        """States a step later (B, nz), and slopes (B / shared, nz, nz) of the first of neighbours in those before."""
        b, nz = z.shape
        small = _SMALL_STATE * z.abs().amax(0).clamp_min(1e-2)
        first = z[::shared]
        moved = (first[:, None] + torch.diag(small)).reshape(-1, nz)
        t, v = (torch.cat((own, own[::shared].repeat_interleave(nz, 0))) for own in (theta, u))
        later = self.rollouts.later(t, k, torch.cat((z, moved)), v)
        around = later[b:].reshape(len(first), nz, nz)
        return later[:b], ((around - later[:b:shared, None]) / small[:, None]).mT

    def _looked(self, problems: Sequence[FilterProblem], theta: Array) -> list[_Look]:
        """Cost of each problem at its parameters (P, k), and its slopes with the gains there.

        What a change of the gains does to innovations averages out, as both are of earlier noise, and costs several
        times as much to know.
        """
        k = theta.shape[1]
        small = _SMALL * np.maximum(self.vector.scale, 1e-6)
        rows, states, inputs = [], [], []
        for q, at in zip(problems, theta, strict=True):
            around = np.concatenate((at[None], at + np.diag(small)))
            for x, u in zip(q.states, q.inputs, strict=True):
                rows.append(around)
                states += [x] * (k + 1)
                inputs += [u] * (k + 1)
        white, dets = self.innovations(np.concatenate(rows), states, inputs, shared=k + 1)
        white, dets = np.nan_to_num(white, nan=1e3, posinf=1e3, neginf=-1e3), np.nan_to_num(dets, nan=1e6)
        out, first = [], 0
        for q, at in zip(problems, theta, strict=True):
            info, pull = q.information.copy(), q.information @ (q.centre - at)
            away = at - q.centre
            cost, count = 0.5 * float(away @ q.information @ away), 0
            square, moved = 0.0, (2.0 * cost) ** 0.5
            for u in q.inputs:
                w = white[first : first + k + 1].reshape(k + 1, -1)
                j = (w[1:] - w[0]) / small[:, None]
                info += j @ j.T
                pull -= j @ w[0]
                square += float(w[0] @ w[0])
                cost += 0.5 * float(w[0] @ w[0]) + float(dets[first])
                count += len(u) * self._nx
                first += k + 1
            out.append(_Look(cost, pull, info, square, count, moved))
        return out


def _bounded(pull: Array, info: Array, at: Array, inside: object) -> Array:
    """Gauss and Newton's step, without what would leave the bounds."""
    assert callable(inside)
    free = np.ones(len(at), dtype=bool)
    room = info + np.diag(_ROOM * np.maximum(np.diag(info), 1e-12))
    for _ in range(len(at)):
        step = np.zeros(len(at))
        step[free] = np.linalg.solve(room[np.ix_(free, free)], pull[free])
        stuck = free & (np.abs(inside(at + step) - at) < 1e-3 * np.abs(step)) & (step != 0)
        if not stuck.any():
            break
        free &= ~stuck
    return step


def _padded(rows: Array, length: int) -> Array:
    return np.concatenate((rows, np.repeat(rows[-1:], length - len(rows), 0))) if len(rows) < length else rows


def stretches(runs: Sequence[Run]) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Measured states and inputs of every stretch of runs without a gap."""
    parts = [(run.x[a:b], run.u[a : b - 1]) for run in runs for a, b in run.segments if b - a > 2]
    return tuple(x for x, _ in parts), tuple(u for _, u in parts)
