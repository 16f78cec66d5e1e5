"""Rates that no sensor measured, inferred from positions with the physics in the loop.

    foretold (p, v) = physics over a step from the estimate before,   e = q - p
    p <- p + alpha e,   v <- v + beta e / h                           (`nsde_torch.data.tracking`)

The estimate of a row knows that row and those before it, and none after: what it lacks of the true rate is then
independent of the noise that comes, and physics fitted at it, averaged over what it lacks (`Physics`), is not bent by
noise in its regressors. A smoother, which knows rows on both sides, would be nearer to the truth and bend friction.

Gains are those of the smallest e, one pair for each position, never slower than `SLOWEST_S`: in that time rates forget
what the physics says of them, so that wrong physics hardly counts. Pieces of the runs are followed side by side.

The rates hang a little on the parameters: they are inferred again until these have settled (`in_turn`).
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.data import Run
from nsde_torch.data.system_info import rate_pairs
from nsde_torch.data.tracking import SLOWEST_S, gains
from nsde_torch.sysid.result import Identification
from nsde_torch.sysid.steps import inferred_columns
from nsde_torch.systems import System

Array = NDArray[np.float64]

TURNS = 4
"""Times that rates are inferred, at most."""
SETTLED = 0.2
"""Standard errors that parameters may still move by."""
_GAINS = 8
_PIECE_S = 2.0
_BEFORE_S = 10.0 * SLOWEST_S  # before each piece; after it its start is forgotten


def with_rates(system: System, runs: Sequence[Run], clock: float = 1.0) -> list[Run]:
    """Runs with inferred rates as the physics of a system foretells them; the runs themselves where none are inferred.

    Args:
        system: The machine with its values; it is not changed.
        runs: Recordings, all on one step.
        clock: Physical seconds per logged second.
    """
    columns = inferred_columns(system, runs) if runs else {}
    if not columns:
        return list(runs)
    machine, dt = copy.deepcopy(system).double(), runs[0].dt * clock
    machine.set_step(dt)
    names = list(machine.state_names)
    pairs = [(i, j) for i, j in rate_pairs(machine) if j in columns]
    followed = _Followed(machine, runs, pairs, dt)
    with torch.no_grad():
        rates, unknown = followed.rates()
    states = [np.array(run.x) for run in runs]
    for (_, j), values in zip(pairs, rates, strict=True):
        for x, part in zip(states, values, strict=True):
            good = np.isfinite(part)
            x[good, j] = part[good]
    told = {names[j]: std for (_, j), std in zip(pairs, unknown, strict=True)}
    return [replace(run, x=x, inferred=told) for run, x in zip(runs, states, strict=True)]


def in_turn(
    system: System,
    runs: Sequence[Run],
    clock: float,
    identified: Callable[[System, Sequence[Run]], Identification],
) -> Identification:
    """What an identification finds at rates that its own physics foretells.

    Args:
        system: The machine; its values are where the iteration starts. It is not changed.
        runs: Recordings, all on one step.
        clock: Physical seconds per logged second.
        identified: Identifies a system from runs.
    """
    if not (runs and runs[0].inferred):
        return identified(system, runs)
    machine = copy.deepcopy(system)
    found = identified(machine, with_rates(machine, runs, clock))
    for _ in range(TURNS - 1):
        before = found.values
        found.vector.write(machine, before)
        found = identified(machine, with_rates(machine, runs, clock))
        error = np.sqrt(np.diag(found.covariance).clip(0.0))
        if (np.abs(found.values - before) <= SETTLED * error)[found.shown.known].all():
            break
    return found


class _Followed:
    """Pieces of runs, side by side, and each with all gains."""

    def __init__(
        self, system: System, runs: Sequence[Run], pairs: Sequence[tuple[int, int]], dt: float
    ) -> None:
        self._system, self._runs, self._dt = system, runs, dt
        self._positions, self._rates = [i for i, _ in pairs], [j for _, j in pairs]
        length, before = max(1, round(_PIECE_S / dt)), round(_BEFORE_S / dt)
        self._pieces = [
            (n, c, min(c + length, b), max(a, c - before))
            for n, run in enumerate(runs)
            for a, b in run.segments
            for c in range(a, b, length)
        ]
        self._rows = max(end - start for _, _, end, start in self._pieces)

    def rates(self) -> tuple[list[list[Array]], list[float]]:
        """By pair: rates of each run (n,), nan outside segments, and what is not known of them."""
        tried = gains(self._dt, _GAINS)
        alpha, beta = (torch.tensor([getattr(g, k) for g in tried]) for k in ("alpha", "beta"))
        t, x, u, inside = self._gathered()
        many = len(self._pieces)
        alpha, beta = (
            alpha.double().repeat_interleave(many)[:, None],
            beta.double().repeat_interleave(many)[:, None],
        )
        system, h = self._system, self._dt
        z = system.augment(x[0], u[0]).repeat(len(tried), 1)
        rates, errors = [], []
        for k in range(self._rows):
            seen = x[k].repeat(len(tried), 1)
            e = seen[:, self._positions] - z[:, self._positions]
            now = torch.cat((seen, z[:, system.nx :]), 1)
            now[:, self._positions] = z[:, self._positions] + alpha * e
            now[:, self._rates] = z[:, self._rates] + beta * e / h
            rates.append(now[:, self._rates])
            errors.append(e.square())
            z = self._later(t[k].repeat(len(tried)), now, u[k].repeat(len(tried), 1))
        v = torch.stack(rates).view(self._rows, len(tried), many, -1).numpy()
        square = torch.stack(errors).view(self._rows, len(tried), many, -1).numpy()
        own = np.array(
            [[start + k >= first for _, first, _, start in self._pieces] for k in range(self._rows)]
        )
        own &= inside.numpy()
        judged = own & (np.arange(self._rows)[:, None] >= 30) if (own[30:]).any() else own
        out, unknown = [], []
        for m in range(len(self._rates)):
            mean = np.array(
                [np.nan_to_num(square[:, g, :, m][judged], nan=np.inf).mean() for g in range(len(tried))]
            )
            best = int(np.argmin(mean))
            unknown.append(tried[best].unknown(float(mean[best]), h))
            values = [np.full(len(run), np.nan) for run in self._runs]
            for p, (n, first, end, start) in enumerate(self._pieces):
                values[n][first:end] = v[first - start : end - start, best, p, m]
            out.append(values)
        return out, unknown

    def _gathered(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Times (rows, pieces), states and inputs (rows, pieces, columns), and which rows are there."""
        parts: list[list[Array]] = [[], [], []]
        inside = []
        for n, _, end, start in self._pieces:
            run = self._runs[n]
            rows = np.minimum(np.arange(start, start + self._rows), end - 1)
            for part, values in zip(parts, (run.t, run.x, run.u), strict=True):
                part.append(values[rows])
            inside.append(np.arange(start, start + self._rows) < end)
        t, x, u = (torch.from_numpy(np.stack(part, 1)) for part in parts)
        return t, x, u, torch.from_numpy(np.stack(inside, 1))

    def _later(self, t: Tensor, z: Tensor, u: Tensor) -> Tensor:
        """States (N, nz) a step later, by the midpoint rule."""
        system, h = self._system, self._dt
        middle = system.inner(z, z + 0.5 * h * system.drift(t, z, u))
        return z + h * system.drift(t + 0.5 * h, middle, u)
