"""Output-error estimates by shooting: parameters whose open-loop rollouts come closest to what was measured.

Over windows w with initial states x_w and all parameters theta,

    min_{theta, x_w}  sum_w sum_k | W (y(x(t_k; x_w, theta)) - y_k) |^2

by Gauss-Newton with the damping of Marquardt; the initial states of a window appear in its own rows alone and are
eliminated by the Schur complement (Bock, Recent advances in parameter identification techniques for O.D.E., 1983).
Slopes are forward differences of rollouts. Noise of the process is not modelled: what the model does not explain is
taken for noise of the sensors, which is what a benchmark asks that scores a simulation.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.errors import DataError, NonFiniteError
from nsde_torch.sde.integrate import rollout
from nsde_torch.sde.registry import make_step
from nsde_torch.sde.step import Calculus, Time
from nsde_torch.systems.base import System
from nsde_torch.systems.options import system_options
from nsde_torch.systems.parameters import ParameterVector

from .files import Say, Work

_STEP = 1e-6
_ENOUGH = 1e-5
"""Relative fall of the cost of an iteration that ends the search."""
_ROWS = 2048
"""Rows of a batch of perturbed rollouts."""


def silent(stage: str, done: int, total: int) -> None:
    """No progress."""


@dataclass(frozen=True)
class Stretches:
    """Stretches of measured runs of one length."""

    # measured states (B, T + 1, nx); of a channel that is not scored only the first row is used, as a start
    x: Array
    u: Array  # inputs (B, T * finer, nu), held over a step of `dt / finer`
    dt: float  # step of the rows of `x` [s]
    finer: int = 1  # steps of the integrator in a step of the rows


@dataclass(frozen=True)
class OutputErrorEstimate:
    """What the search found."""

    # value of each declared parameter, by name (a list where it has axes)
    values: dict[str, float | list[float]]
    starts: Array  # initial states (B, nx)
    errors: Array  # predicted minus measured in error channels (B, T, n_error) at the end
    cost: tuple[float, ...]  # mean of the squared weighted errors, before each iteration and at the end


def machine(system: str | type[System], effects: Any = (), values: Mapping[str, Any] | None = None) -> System:
    """A machine in double precision, with effects and values of its parameters."""
    return system_options(system, effects=effects, parameters=values or {}).make().double()


def with_units(system: System, values: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Values of declared parameters, each with its unit."""
    declared = system.all_declared()
    return {name: {"value": value, "unit": declared[name][1]} for name, value in values.items()}


def by_name(vector: ParameterVector, theta: Array) -> dict[str, Any]:
    """Values of parameters; a list where a parameter has axes."""
    found = {place.name: theta[place.columns].tolist() for place in vector.places}
    return {name: value[0] if len(value) == 1 else value for name, value in found.items()}


def rms(error: Array) -> float:
    return float(np.sqrt((error**2).mean()))


def kept_array(work: Work, name: str, make: Callable[[], Array]) -> Array:
    """A simulation that is kept as a stage."""

    def simulate() -> dict[str, Any]:
        work.say(f"simulating {name.replace('_', ' ')}", 0, 1)
        return {"y": make().tolist()}

    return np.array(work.stage(f"simulation_{name}", simulate)["y"])


def times(count: int, dt: float) -> Array:
    """Times of rows (count,) [s]."""
    return np.arange(count, dtype=np.float64) * dt


def windows(
    x: Sequence[Array],
    u: Sequence[Array],
    *,
    dt: float,
    length: int,
    stride: int | None = None,
    finer: int = 1,
) -> Stretches:
    """Cut runs into stretches."""
    starts = [(r, k) for r, run in enumerate(x) for k in range(0, len(run) - length, stride or length)]
    if not starts:
        longest = max((len(run) for run in x), default=0)
        raise DataError(
            f"Windows of {length} steps need runs of more rows; the longest has {longest}. Take the whole files."
        )
    return Stretches(
        np.stack([x[r][k : k + length + 1] for r, k in starts]),
        np.stack([u[r][k * finer : (k + length) * finer] for r, k in starts]),
        dt,
        finer,
    )


def simulated(
    system: System, start: Array, u: Array, *, dt: float, finer: int = 1, rows: int = 4096
) -> Array:
    """Open-loop rollouts by Runge-Kutta 4, without noise."""
    quick = ParameterVector(system).system  # its parameters are looked up, not worked out at every step
    x, inputs = torch.from_numpy(start), torch.from_numpy(u)
    with torch.no_grad():
        parts = [
            _rollout(quick, x[k : k + rows], inputs[k : k + rows], dt, finer) for k in range(0, len(x), rows)
        ]
    return torch.cat(parts).numpy()


class _WithoutNoise:
    """The physics of a system as an equation that a solver takes."""

    calculus: Calculus = "either"

    def __init__(self, system: System) -> None:
        self.drift, self.project = system.drift, system.project
        self.set_step, self.inner = system.set_step, system.inner

    def diffusion(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        return torch.zeros_like(z)


def _rollout(system: System, start: Tensor, u: Tensor, dt: float, finer: int) -> Tensor:
    first = start if start.shape[1] > system.nx else system.augment(start, u[:, 0])
    path = rollout(_WithoutNoise(system), first, u, dt=dt / finer, step=make_step("rk4"), noise=None)
    return path[0][:, ::finer, : system.nx]


def output_error(
    system: System,
    data: Stretches,
    *,
    weights: Array,
    free: Sequence[int] = (),
    fixed: Sequence[str] = (),
    groups: Sequence[Sequence[int]] = (),
    side_by_side: bool = False,
    iterations: int = 30,
    stage: str = "fitting",
    say: Say = silent,
) -> OutputErrorEstimate:
    """Fit the declared parameters of a system to rollouts, from its own values; the system is given the result.

    Args:
        weights: One over the typical error of each error channel (n_error,); 0 leaves a channel out.
        free: States whose initial values are fitted; the others start as measured. Columns behind the states are
            memory of the effects, which otherwise starts as they say.
        groups: Error channels whose length is to be small and not its square (iteratively reweighted least squares);
            empty: squares.
        side_by_side: Roll out the slopes in many parameters as rows of one batch (see `ParameterVector.use` for which
            systems): the same numbers, several times faster where stretches are few.
    """
    vector = ParameterVector(system)
    columns = {place.name: range(*place.columns.indices(len(vector))) for place in vector.places}
    moved = np.array([j for name, own in columns.items() if name not in fixed for j in own], dtype=np.int64)
    used = np.flatnonzero(weights > 0)
    u = torch.from_numpy(data.u)
    measured = torch.from_numpy(data.x[:, 1:])
    theta, starts = vector.inside(vector.start), data.x[:, 0].copy()
    if max(free, default=0) >= system.nx:
        vector.use(torch.from_numpy(theta))
        starts = vector.system.augment(torch.from_numpy(starts), u[:, 0]).numpy().copy()

    def errors(theta: Array, starts: Array) -> Array:
        vector.use(torch.from_numpy(theta))
        copies = len(starts) // len(u)
        with torch.no_grad():
            path = _rollout(
                vector.system, torch.from_numpy(starts), u.repeat(copies, 1, 1), data.dt, data.finer
            )
            error = vector.system.error(path[:, 1:], measured.repeat(copies, 1, 1))
            return error.numpy()[..., used] * weights[used]

    def scaled(e: Array) -> Array:
        out = np.ones_like(e)
        for group in groups:
            own = np.flatnonzero(np.isin(used, np.asarray(group)))
            length = np.sqrt((e[..., own] ** 2).mean(-1, keepdims=True))
            out[..., own] = 1.0 / np.sqrt(np.maximum(length, 0.05 * np.median(length) + 1e-12))
        return out

    def slopes_of(theta: Array, starts: Array, now: Array, share: Array) -> tuple[Array, Array]:
        """Slopes of the weighted errors in the parameters (B, R, k) and in the initial states (B, R, f)."""
        rows, together = now[0].size, max(1, _ROWS // len(starts)) if side_by_side else 1
        moves: list[tuple[Array, Array, float]] = []
        for column in moved:
            size = _STEP * max(vector.scale[column], abs(theta[column]))
            up = theta.copy()
            up[column] += size if theta[column] + size < vector.high[column] else -size
            moves.append((up, starts, up[column] - theta[column]))
        for column in free:
            size = _STEP * max(float(np.abs(starts[:, column]).max()), 1e-6)
            up = starts.copy()
            up[:, column] += size
            moves.append((theta, up, size))
        slopes = np.empty((len(now), rows, len(moves)))
        for k in range(0, len(moves), together):
            thetas, firsts, sizes = zip(*moves[k : k + together], strict=True)
            of_rows = np.repeat(np.stack(thetas), len(now), 0) if len(thetas) > 1 else thetas[0]
            ends = errors(of_rows, np.concatenate(firsts)).reshape(len(thetas), *now.shape)
            for j, (end, size) in enumerate(zip(ends, sizes, strict=True)):
                slopes[..., k + j] = ((end - now) * share).reshape(len(now), rows) / size
        return slopes[..., : len(moved)], slopes[..., len(moved) :]

    now = errors(theta, starts)
    share = scaled(now)
    cost = [float(((now * share) ** 2).mean())]
    damping = 1e-3
    for done in range(iterations):
        say(stage, done, iterations)
        slopes = slopes_of(theta, starts, now, share)
        better = False
        for _ in range(8):
            step, shift = _solve(*slopes, (now * share).reshape(len(now), -1), damping)
            new_theta, new_starts = theta.copy(), starts.copy()
            new_theta[moved] += step
            new_theta = vector.inside(new_theta)
            new_starts[:, list(free)] += shift
            try:
                new = errors(new_theta, new_starts)
            except NonFiniteError:
                new = np.full_like(now, np.inf)
            with np.errstate(over="ignore"):  # a step too far
                total = float(((new * share) ** 2).mean())
            if np.isfinite(total) and total < cost[-1]:
                better = True
                break
            damping *= 5.0
        if not better:
            break
        fell = 1.0 - total / cost[-1]
        theta, starts, now, damping = new_theta, new_starts, new, max(damping / 10.0, 1e-12)
        share = scaled(now)
        cost.append(float(((now * share) ** 2).mean()))
        if fell < _ENOUGH:
            break
    vector.write(system, theta)
    say(stage, iterations, iterations)
    full = np.zeros((*now.shape[:2], len(weights)))
    full[..., used] = now / weights[used]
    return OutputErrorEstimate(by_name(vector, theta), starts[:, : system.nx], full, tuple(cost))


def _solve(by_theta: Array, by_start: Array, errors: Array, damping: float) -> tuple[Array, Array]:
    """Step of the parameters (k,) and of the initial states (B, f)."""
    a = np.einsum("brj,brk->jk", by_theta, by_theta)
    g = np.einsum("brj,br->j", by_theta, errors)
    if by_start.shape[-1]:
        c = np.einsum("brj,brk->bjk", by_start, by_start)
        c += (damping * np.einsum("bjj->bj", c) + 1e-300)[:, :, None] * np.eye(c.shape[-1])
        d = np.einsum("brj,brk->bjk", by_theta, by_start)
        h = np.einsum("brj,br->bj", by_start, errors)
        inverse = np.linalg.pinv(c)
        gain = np.einsum("bjk,bkl->bjl", d, inverse)
        a = a - np.einsum("bjl,bkl->jk", gain, d)
        g = g - np.einsum("bjl,bl->j", gain, h)
    size = np.sqrt(np.maximum(np.diag(a), 1e-300))
    scaled = a / size[:, None] / size[None, :] + damping * np.eye(len(a))
    step: Array = -np.linalg.solve(scaled, g / size) / size
    if not by_start.shape[-1]:
        return step, np.zeros((len(errors), 0))
    shift: Array = -np.einsum("bjk,bk->bj", inverse, h + np.einsum("bjk,j->bk", d, step))
    return step, shift
