"""A machine as the filter sees it: a step, its linearisation in the state, and what parameters do to it.

The state of the filter is the error of the machine's state (three columns of an attitude, `System.error`) with the
disturbances d of the ports behind it. Memory of the effects (lags, delays) is known from the inputs and the measured
states (`memory_along`), and no state of the filter. What resonates would take the noise of measured states up: such
memory (`Effect.estimated`) stands behind the states of the machine.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import isfinite
from typing import final

import torch
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.columns import join_columns, split_columns
from nsde_torch.effects import Port
from nsde_torch.inference.steps import (
    Chunks,
    Steps,
    low_passed,
    memory_along,
    memory_as_measured,
    memory_moves,
)
from nsde_torch.rotation import body_rates, turned
from nsde_torch.sde.exponential import MOSTLY, differences, exponentials, largest, stiff_change, stiff_rows
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector

_SMALL = 1e-6  # differences of disturbances, and of errors of an attitude
_AT_ONCE = 8000  # rows that are linearised at once
_ALIKE, _SOME = 0.999, 500  # cosine of pushes from which one of two is enough, and rows that say so
# of a parameter's scale: differences. With 1e-7 rounding passed for knowledge of how much all motors have lost, and a
# weak motor of six that four commands drive had a loss of 0 to 1 (tests/inference/test_slopes.py)
_SHARE = 1e-5


def disturbances_of(system: System, t: Tensor, x: Tensor, u: Tensor) -> tuple[tuple[Port, int], ...]:
    """Columns of the ports on which the machine is disturbed; of those that push alike in rows (N, ...), the first.

    States that none of them pushes, as a pressure or a current, are disturbed in their own rate, unless they are the
    place of another one. Taken for exact, what disturbs the pressure of a cylinder was a viscoelasticity and a hidden
    mass of a rod that lacks nothing (tests/diagnosis/test_own_machines.py).
    """
    ports = system.disturbed_ports or tuple(p for p in system.ports if p not in (Port.INPUT, Port.RATE))
    rate = system.drift(t, x, u)[:, : system.nx]
    kept: list[tuple[Port, int]] = []
    pushes: list[Tensor] = []
    for port in ports:
        for j in range(system.ports[port]):
            force = x.new_zeros(len(x), system.ports[port])
            force[:, j] = 1.0
            push = (system.drift(t, x, u, {port: force})[:, : system.nx] - rate).flatten()
            push = push / push.norm().clamp_min(1e-300)
            if all(float((push @ other).abs()) < _ALIKE for other in pushes):
                kept.append((port, j))
                pushes.append(push)
    if system.disturbed_ports:
        return tuple(kept)
    moved = (
        torch.stack(pushes).view(len(pushes), -1, system.nx).abs().amax((0, 1)) > 0
        if pushes
        else rate[0] != rate[0]
    )
    places = {system.state_names.index(place) for place, _, _ in system.position_derivatives}
    places |= {at.position for at in system.bound_coordinates() if at.position is not None}
    own = (j for j in range(system.nx) if not moved[j] and j not in places)
    return (*kept, *((Port.RATE, j) for j in own))


def forces_on(system: System, disturbances: Sequence[tuple[Port, int]], values: Tensor) -> dict[Port, Tensor]:
    """Forces on the ports of a machine, from values (N, nd) of disturbances on some of their columns."""
    out: dict[Port, Tensor] = {}
    for j, (port, column) in enumerate(disturbances):
        unit = torch.zeros(system.width_of(port), dtype=values.dtype)
        unit[column] = 1.0
        push = values[:, j : j + 1] * unit
        out[port] = out[port] + push if port in out else push
    return out


def moved(system: System, x: Tensor, error: Tensor) -> Tensor:
    """States (N, nx) moved by errors (N or 1, ne)."""
    q = system.quaternion
    if q is None:
        return x + error
    a, b = q.start, q.stop
    attitude = turned(x[:, a:b], error[:, a : a + 3])
    return join_columns((x[:, :a] + error[:, :a], attitude, x[:, b:] + error[:, a + 3 :]))


def _error_rate(system: System, x: Tensor, rate: Tensor) -> Tensor:
    """Rates of states (N, nx) in error channels (N, ne): of an attitude, its body rates [rad/s]."""
    q = system.quaternion
    if q is None:
        return rate
    before, turns, after = split_columns(rate, q.start, q.stop - q.start, rate.shape[1] - q.stop)
    return join_columns((before, body_rates(x[:, q], turns), after))


def _rows(values: Tensor) -> Tensor:
    """Values (T, C, ...) as rows (T C, ...)."""
    return values.flatten(0, 1)


@dataclass(frozen=True)
class Along:
    """Places along steps at which slopes in parameters are taken."""

    places: Sequence[tuple[slice | Tensor, Tensor, float]]
    """Rows, states (N, nx) there, and how far from the middle: all of them there, of stiff ones both ends."""
    rates: Sequence[Tensor]  # of the physics that it was made of, at each of these (ne, N)
    weights: tuple[Tensor, Tensor] | None  # of the start and the end (N, ne, ne); None where no row is stiff


@final
class StateSpace:
    """A machine over the chunks of a log.

    Args:
        observed: Numbers of the measured error channels.
        every: Rows from one measurement of each of these to the next.
        band: Frequencies above which states were smoothed away [Hz], by error channel.
        disturbances: Columns of the ports on which the machine is disturbed; None finds them (`disturbances_of`).
        estimates: Names of the effects whose memory is a state of the filter; None: of all that ask for it.

    Attributes:
        estimates, estimated: The effects whose memory is estimated, and its columns among all memory.
        nx: Number of states, the machine's and estimated memory.
        ne, nd, n: Number of errors of these, of disturbances, and of both.
        least_sensor: Logarithm of the least noise of each observed channel (m,), below which all is arithmetic.
        measured: Whether a row measures each observed channel (T, C, m), outliers not; None where all do.
    """

    def __init__(
        self,
        vector: ParameterVector,
        steps: Steps,
        chunks: Chunks,
        observed: Sequence[int],
        every: Sequence[int],
        band: Mapping[int, float],
        disturbances: tuple[tuple[Port, int], ...] | None,
        estimates: tuple[str, ...] | None = None,
    ) -> None:
        self.vector, self.steps, self.chunks, self.observed = vector, steps, chunks, list(observed)
        self.h, self.logged_h = steps.dt, steps.logged_dt
        system, some = vector.system, slice(None, None, max(1, len(steps) // _SOME))
        rows = system.project(system.augment(steps.x0[some], steps.u[some]))
        self.disturbances = disturbances or disturbances_of(system, steps.t[some], rows, steps.u[some])
        self.estimates = system.estimated_effects if estimates is None else estimates
        self.estimated = system.memory_columns(self.estimates)
        self.nx = system.nx + len(self.estimated)
        self.ne = len(system.error_names) + len(self.estimated)
        self.nd = len(self.disturbances)
        self.n = self.ne + self.nd
        self.every, self.band = list(every), dict(band)
        self.least_sensor = torch.full((len(self.observed),), -torch.inf, dtype=torch.float64)
        self.measured = None if max(self.every) == 1 else self.logged
        self.stiff: Tensor | None = None  # rows that are stiff (T, C), as the last linearisation found them
        self.fastest = torch.inf  # of `speed`, beyond which physics has no likelihood

    @property
    def logged(self) -> Tensor:
        """Whether a row logs each observed channel (T, C, m)."""
        return self.chunks.since[..., None] % torch.tensor(self.every) == 0

    def some(self, which: Tensor) -> "StateSpace":
        """The same machine, with the values in use, over some of the chunks."""
        out = copy.copy(self)
        out.chunks = self.chunks.some(which)
        out.memory, out.begun = self.memory[:, which], self.begun[:, which]
        out._moves = None if self._moves is None else self._moves[:, which]
        out.measured = None if self.measured is None else self.measured[:, which]
        out.stiff = None if self.stiff is None else self.stiff[:, which]
        return out

    @property
    def measurements(self) -> int:
        """Number of measured values in the rows that count."""
        counted = self.chunks.counted
        if self.measured is None:
            return int(counted.sum()) * len(self.observed)
        return int((self.measured & counted[..., None]).sum())

    def use(self, theta: Array) -> None:
        """Take these values (k,) for what follows, or those of each stretch of the log (S, k)."""
        self.theta = torch.as_tensor(theta)
        self._take(self.theta)
        self.memory, self.begun = self._memory()
        self._moves: Tensor | None = None

    @property
    def _sizes(self) -> Array:
        """Sizes of the values in use (k,), of those of each stretch the largest."""
        return self.vector.size(self.theta.abs().view(-1, len(self.vector)).amax(0).numpy())

    def _take(self, theta: Tensor) -> None:
        """Take values for all but memory."""
        self._now, self._many = theta, theta.dim() > 1
        self.vector.use(theta)

    def _memory(self) -> tuple[Tensor, Tensor]:
        """Memory of the effects over the step from each row (T, C, nz - nx), and what is estimated, at each row."""
        before, after = self._of_stretches(memory_along)
        return self.chunks.cut(0.5 * (before + after)), self.chunks.cut(before[:, list(self.estimated)])

    def _movement(self) -> Tensor:
        """By how much memory changes over the step from each row (T, C, nz - nx)."""
        return self.chunks.cut(self._of_stretches(memory_moves)[0])

    @property
    def moves(self) -> Tensor | None:
        """See `_movement`; None where no row is stiff."""
        if self.stiff is None:
            return None
        if self._moves is None:
            self._moves = self._movement()
        return self._moves

    def _of_stretches(self, made: Callable[[System, Steps], tuple[Tensor, ...]]) -> list[Tensor]:
        """What is made of all steps (N, nz - nx), under values that may differ from stretch to stretch."""
        system = self.vector.system
        if system.nz == system.nx:
            return [self.steps.x0.new_zeros(len(self.steps), 0)] * 2
        if not self._many:
            return list(made(system, self.steps))
        each, owner = torch.unique(self._now, dim=0, return_inverse=True)
        out: list[Tensor] = []
        for i, theta in enumerate(each):
            self.vector.use(theta)
            part, rows = self.steps.of(torch.nonzero(owner == i)[:, 0].tolist())
            values = made(system, part)
            out = out or [v.new_empty(len(self.steps), v.shape[1]) for v in values]
            for whole, own in zip(out, values, strict=True):
                whole[rows] = own
        return out

    def states(self, x: Tensor) -> Tensor:
        """States (T, C, nx) from the machine's (T, C, k), with estimated memory as it follows what was measured."""
        return torch.cat((x, self.begun[: len(x)]), -1) if self.estimated else x

    def with_memory(self, x: Tensor, memory: Tensor) -> Tensor:
        """States of the machine and memory of its effects (N, nz), from states (N, nx) and followed memory."""
        own, inside = self.vector.system.nx, list(self.estimated)
        if inside:
            columns = list(memory.unbind(1))
            for k, column in zip(inside, x[:, own:].unbind(1), strict=True):
                columns[k] = column
            memory = torch.stack(columns, 1)
        return join_columns((x[:, :own], memory)) if memory.shape[1] else x

    def error(self, x: Tensor, other: Tensor) -> Tensor:
        """States less others (..., ne)."""
        own, system = self.vector.system.nx, self.vector.system
        if not self.estimated:
            return system.error(x, other)
        apart = system.error(x[..., :own], other[..., :own])
        return torch.cat((apart, x[..., own:] - other[..., own:]), -1)

    def seen(self, x: Tensor) -> Tensor:
        """What was measured less states (T, C, nx), in measured channels (T, C, m)."""
        system = self.vector.system
        return system.error(self.chunks.y, x[..., : system.nx])[..., self.observed]

    def first_memory(self, theta: Array, std: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Of estimated memory at some values: what noise (nx,) of the measured states does to it, its size, its start.

        Standard deviations (k,), the second of which is what is not known of it where a recording begins in the middle
        of motion, and what each chunk starts with by what was measured (C, k).
        """
        self._take(torch.as_tensor(theta))
        steps, system, own = self.steps, self.vector.system, list(self.estimated)
        noise = (
            torch.randn(steps.x0.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * std
        )
        x0, x1 = steps.x0 + noise, steps.x1.clone()
        for a, b in steps.segments:
            x1[a : b - 1] = x0[a + 1 : b]
        noisy, clean = (memory_along(system, part) for part in (replace(steps, x0=x0, x1=x1), steps))
        noise_std, size = (values[:, own].std(0) for values in (noisy[0] - clean[0], clean[0]))

        def residual(before: Tensor, after: Tensor) -> Tensor:
            later = self.step(steps.t, join_columns((steps.x0, before[:, own])), before, steps.u)
            return system.error(steps.x1, later[:, : system.nx])

        measured, _ = memory_as_measured(system, steps, clean, own, residual)
        return noise_std, size, self.chunks.cut(measured[:, own])[0]

    def rate(
        self, t: Tensor, x: Tensor, memory: Tensor, u: Tensor, push: Mapping[Port, Tensor] | None = None
    ) -> Tensor:
        """Rates of states (N, nx), all under the same forces (1, width of the port), if any."""
        return self._of_rows(partial(self._rate, push or {}), t, x, memory, u)

    def step(self, t: Tensor, x: Tensor, memory: Tensor, u: Tensor, moves: Tensor | None = None) -> Tensor:
        """States (N, nx) an undisturbed step later: Runge and Kutta's fourth order, in stiff rows an exponential rule.

        Of a dry friction these are the few in which it holds; where most are stiff, or which is not known, all take it.
        There memory changes by `moves` over the step, as what settles within it follows.
        """
        stiff = self.stiff
        if stiff is None:
            return self._of_rows(self._step, t, x, memory, u)
        if self._many or self._mostly_stiff or stiff.numel() != len(x):
            return self._stiff_step(t, x, memory, u, moves)
        out, some = self._of_rows(self._step, t, x, memory, u), _rows(stiff)
        moves = None if moves is None else moves[some]
        out[some] = self._stiff_step(t[some], x[some], memory[some], u[some], moves)
        return out

    def _stiff_step(self, t: Tensor, x: Tensor, memory: Tensor, u: Tensor, moves: Tensor | None) -> Tensor:
        """See `step`: z' = f(z, m + (s / h - 1/2) moves).

        An actuator's lag of 4 s before a node of 0.5 s, logged every 2 s, acted by its mean over the row: 3.3 s.
        """
        late, turns = t + 0.5 * self.logged_h, None
        if moves is not None and bool(moves.any()):
            first, last = (self.rate(late, x, memory + share * moves, u) for share in (-0.5, 0.5))
            turns = last - first
        change = stiff_change(lambda z: self.rate(late, z, memory, u), x, self.h, turns=turns)
        return self._project(x + change)

    @property
    def _mostly_stiff(self) -> bool:
        return self.stiff is not None and float(self.stiff.double().mean()) > MOSTLY

    def _of_rows(self, function: Callable[..., Tensor], t: Tensor, x: Tensor, *rows: Tensor) -> Tensor:
        """A function of rows at the values in use, which may differ from stretch to stretch."""
        if not self._many:
            return function(t, x, *rows)
        theta = self._now[self.chunks.stretch].repeat(len(x) // self.chunks.count, 1)

        def one(theta: Tensor, *row: Tensor) -> Tensor:
            self.vector.use(theta)
            return function(*(part[None] for part in row))[0]

        whole = [part.expand(len(x), *part.shape[1:]) for part in rows]
        after: Tensor = torch.func.vmap(one)(theta, t, x, *whole)
        return after

    def _rate(self, push: Mapping[Port, Tensor], t: Tensor, x: Tensor, memory: Tensor, u: Tensor) -> Tensor:
        forces = {port: force.expand(len(x), -1) for port, force in push.items()}
        system, own = self.vector.system, self.vector.system.nx
        whole = system.drift(t, self.with_memory(x, memory), u, forces)
        if not self.estimated:
            return whole[:, :own]
        return join_columns((whole[:, :own], *(whole[:, own + k : own + k + 1] for k in self.estimated)))

    def _step(self, t: Tensor, x: Tensor, memory: Tensor, u: Tensor) -> Tensor:
        project, h, late, rate = self._project, self.h, self.logged_h, partial(self._rate, {})
        k1 = rate(t, x, memory, u)
        k2 = rate(t + 0.5 * late, project(x + 0.5 * h * k1), memory, u)
        k3 = rate(t + 0.5 * late, project(x + 0.5 * h * k2), memory, u)
        k4 = rate(t + late, project(x + h * k3), memory, u)
        return project(x + (h / 6.0) * (k1 + 2.0 * (k2 + k3) + k4))

    def shifted(self, x: Tensor, error: Tensor) -> Tensor:
        """States (T, C, nx) moved by errors (T, C, ne)."""
        return self._project(moved(self.vector.system, _rows(x), _rows(error))).view(x.shape)

    def _project(self, x: Tensor) -> Tensor:
        """The nearest valid states (N, nx)."""
        own = self.vector.system.nx
        if not self.estimated:
            return self.vector.system.project(x)
        return join_columns((self.vector.system.project(x[:, :own]), x[:, own:]))

    def after(self, x: Tensor) -> Tensor:
        """States a step after some (T, C, nx), undisturbed."""
        t, flat, memory, u = map(_rows, (self.chunks.t, x, self.memory, self.chunks.u))
        moves = None if self.moves is None else _rows(self.moves)
        return self.step(t, flat, memory, u, moves).view(x.shape)

    def midway(self, x: Tensor, after: Tensor | None = None) -> Tensor:
        """States in the middle of the undisturbed step from some (T, C, nx) to those after it, where they are known."""
        after = self.after(x) if after is None else after
        moved = self.error(_rows(after), _rows(x))
        return self.shifted(x, 0.5 * moved.view(*x.shape[:2], self.ne))

    def linearised(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Slopes (T, C, ne, n) of a step at states (T, C, nx) in errors and disturbances, and the states after it.

        With A and B those of the rate in the middle of the step, exp(h A) and h (1 + h A / 2 + ...) B: to fourth order,
        or as they are of a machine that is stiff.
        """
        self.stiff = self._stiff_rows(x)
        after = self.after(x)
        middle, (t, memory, u) = _rows(self.midway(x, after)), self._in_the_middle()
        slopes, eye = x.new_empty(len(middle), self.ne, self.n), torch.eye(self.ne, dtype=x.dtype)
        together = max(1, _AT_ONCE // self.chunks.count) * self.chunks.count
        parts = [slice(first, first + together) for first in range(0, len(middle), together)]
        for rows in parts:  # h A, h B
            slopes[rows] = self._pushed_by(middle[rows], t[rows], memory[rows], u[rows], range(self.n))
        if (later := self._stiff_later(slopes)) is not None:
            after = self.after(x)
            some = slice(None) if self._many else later
            middle = _rows(self.midway(x, after))[some]
            slopes[some] = self._pushed_by(middle, t[some], memory[some], u[some], range(self.n))
        if isfinite(self.fastest) and self._mostly_stiff and not self._median(slopes) <= self.fastest:
            slopes.fill_(torch.nan)
        for rows in parts:
            slopes[rows] = self._mean(slopes[rows][..., : self.ne], rows) @ slopes[rows]
        slopes[..., : self.ne] += eye
        return slopes.view(*x.shape[:2], self.ne, self.n), after

    def speed(self, x: Tensor) -> float:
        """How fast the machine's own states settle in a step at states (T, C, nx), of the median row; see `largest`."""
        if self.vector.system.quaternion is not None:
            return 0.0
        t, memory, u = map(_rows, (self.chunks.t, self.memory, self.chunks.u))
        return self._median(self._pushed_by(_rows(x), t, memory, u, range(self.vector.system.nx)))

    def _median(self, slopes: Tensor) -> float:
        own = self.vector.system.nx
        return float(largest(slopes[:, :own, :own]).median())

    def _stiff_later(self, slopes: Tensor) -> Tensor | None:
        """Further rows that are stiff by slopes in the middle of their steps (T C, ne, n); None: none.

        A ball on a beam that turns round within a step is held there by a dry friction, though not where it begins: to
        fourth order its slope was 1,000 for 0, and the filter diverged.
        """
        if self.vector.system.quaternion is not None:
            return None
        own = self.vector.system.nx
        later = stiff_rows(slopes[:, :own, :own])
        if self.stiff is not None:
            later &= ~_rows(self.stiff)
        if not bool(later.any()):
            return None
        found = later.view(self.chunks.row.shape[0], -1)
        self.stiff = found if self.stiff is None else self.stiff | found
        return later

    def _mean(self, a: Tensor, rows: slice) -> Tensor:
        """(exp(a) - 1) / a of slopes times a step (N, ne, ne): to fourth order, or as it is where rows are stiff."""
        eye = torch.eye(self.ne, dtype=a.dtype)
        mean = torch.baddbmm(eye, a, torch.baddbmm(eye, a, eye + 0.25 * a, alpha=1.0 / 3.0), alpha=0.5)
        if self.stiff is not None:
            some = _rows(self.stiff)[rows]
            mean[some] = exponentials(a[some])[0]
        return mean

    def _stiff_rows(self, x: Tensor) -> Tensor | None:
        """Rows (T, C) in which something settles in hardly more than a step, at states (T, C, nx); None: in none.

        By its own states: what an effect remembers may oscillate faster, and candidates that do took a cart's diagnosis
        15 s more. A machine that knows its attitude is never taken for stiff: what settles there is memory of motors.
        """
        if self.vector.system.quaternion is not None:
            return None
        t, memory, u = map(_rows, (self.chunks.t, self.memory, self.chunks.u))
        own = self.vector.system.nx
        found = stiff_rows(self._pushed_by(_rows(x), t, memory, u, range(own))[:, :own])
        return found.view(x.shape[:2]) if bool(found.any()) else None

    def _pushed_by(self, x: Tensor, t: Tensor, memory: Tensor, u: Tensor, which: Sequence[int]) -> Tensor:
        """What a step does (N, ne, k) per error of the state, or per force of a disturbance, numbered behind."""
        system, q = self.vector.system, self.vector.system.quaternion
        base = _error_rate(system, x, self.rate(t, x, memory, u))
        out = x.new_empty(len(which), self.ne, len(x))
        small = x.new_full((self.n,), _SMALL)
        if q is None:
            small[: self.ne] = differences(x)
        for i, j in enumerate(which):
            error, there = x.new_zeros(1, self.ne), x
            push: Mapping[Port, Tensor] = {}
            if j < self.ne:
                error[0, j] = small[j]
                there = moved(system, x, error)
            else:
                acts = self.disturbances[j - self.ne : j - self.ne + 1]
                push = forces_on(system, acts, x.new_full((1, 1), _SMALL))
            rate = _error_rate(system, there, self.rate(t, there, memory, u, push))
            torch.sub(rate.T, base.T, out=out[i])
            if q is not None:  # e' = w_x - w_y + e x w_y, to first order
                turns = slice(q.start, q.start + 3)
                out[i, turns] += torch.linalg.cross(error[:, turns].expand(len(x), 3), base[:, turns]).T
        return out.mul_(self.h / small[list(which)].view(-1, 1, 1)).permute(2, 1, 0).contiguous()

    def along(self, x: Tensor, after: Tensor | None = None) -> "Along":
        """Where slopes in parameters are taken of the steps from states (T, C, nx) to those after them, if known."""
        after = self.after(x) if after is None else after
        middle, (t, memory, u) = _rows(self.midway(x, after)), self._in_the_middle()
        places: list[tuple[slice | Tensor, Tensor, float]] = [(slice(None), middle, 0.0)]
        weights = None
        if self.stiff is not None:
            whole = self._many or self._mostly_stiff
            rows = torch.arange(len(middle)) if whole else _rows(self.stiff).nonzero()[:, 0]
            a = self._pushed_by(middle[rows], t[rows], memory[rows], u[rows], range(self.ne))
            one, two, _ = exponentials(a)
            places += [(rows, _rows(end)[rows], share) for end, share in ((x, -0.5), (after, 0.5))]
            weights = one - two, two
        return Along(places, self._rates_at(places, memory, self.moves), weights)

    def _rates_at(
        self, places: Sequence[tuple[slice | Tensor, Tensor, float]], memory: Tensor, moves: Tensor | None
    ) -> list[Tensor]:
        """Undisturbed rates (ne, N) at places along the steps (`Along`), with memory (T C, nz - nx) that moves."""
        t, _, u = self._in_the_middle()
        system, out = self.vector.system, []
        for some, z, share in places:
            held = memory[some] if moves is None or not share else memory[some] + share * _rows(moves)[some]
            out.append(_error_rate(system, z, self.rate(t[some], z, held, u[some])).T)
        return out

    def columns(
        self,
        x: Tensor,
        slopes: Tensor,
        which: Sequence[int],
        after: Tensor | None = None,
        along: "Along | None" = None,
        *,
        beside: bool = False,
    ) -> Tensor:
        """What some parameters do to a step (T, C, ne, k) at states (T, C, nx).

        What they do to the rate in the middle of the step, carried to its end: second order in h, of directions in
        which the likelihood is then climbed as it is. Of stiff rows, with A the slopes of the rate in the middle, a
        what they do to it at the start and b at the end,

            h (phi_1(h A) - phi_2(h A)) a + h phi_2(h A) b

        as for a rate that changes evenly; of a machine that is stiff in most rows, by differences of steps
        (`_stiff_columns`), unless `along` is given: ten times as fast, and enough for a candidate.

        Args:
            slopes: Of the step from these (T, C, ne, n).
            which: Numbers of the parameters.
            after: States after the undisturbed step, where they are known.
            along: Where they are taken, and the rates there, of this or of other physics of the same steps.
            beside: Whether `along` is of other physics: what this does beside it is then the first of the columns
                (T, C, ne, 1 + k).
        """
        if along is None and self._mostly_stiff:
            return self._stiff_columns(x, which)
        v, memory, moves = self.vector, _rows(self.memory), self.moves
        along = self.along(x, after) if along is None else along
        own, first = self._rates_at(along.places, memory, moves) if beside else along.rates, int(beside)
        changes = [base.new_empty(first + len(which), *base.shape) for base in own]
        if beside:
            for out, mine, theirs in zip(changes, own, along.rates, strict=True):
                torch.sub(mine, theirs, out=out[0]).mul_(self.h)
        sizes = self._sizes
        for i, j in enumerate(which, first):
            remembers = v.moves_memory[j] and v.system.nz > self.nx
            by = _SHARE * float(sizes[j])
            theta = self.theta.clone()
            theta[..., j] += by
            self._take(theta)
            held = _rows(self._memory()[0]) if remembers else memory
            changed = self._movement() if remembers and moves is not None else moves
            rates = self._rates_at(along.places, held, changed)
            for out, rate, base in zip(changes, rates, own, strict=True):
                torch.sub(rate, base, out=out[i]).mul_(self.h / by)
        self._take(self.theta)
        middle, *ends = (change.permute(2, 1, 0).contiguous() for change in changes)
        moved = self._to_the_end(middle, slopes)
        if along.weights is not None:
            (rows, *_), (before, later) = along.places[1], along.weights
            _rows(moved)[rows] = before @ ends[0] + later @ ends[1]
        return self.passed(moved)

    def _stiff_columns(self, x: Tensor, which: Sequence[int]) -> Tensor:
        """See `columns`: by differences of steps.

        What settles within a step is not where its middle seems to be: of a motor whose current does, how fast it is
        seemed to be known three hundred times as well as it was, and the fit crept towards it.
        """
        v, base, out = self.vector, self.after(x), list[Tensor]()
        t, flat, u = map(_rows, (self.chunks.t, x, self.chunks.u))
        sizes = self._sizes
        for j in which:
            by = _SHARE * float(sizes[j])
            theta = self.theta.clone()
            theta[..., j] += by
            self._take(theta)
            remembers = v.moves_memory[j] and v.system.nz > self.nx
            held, moves = (self._memory()[0], self._movement()) if remembers else (self.memory, self.moves)
            assert moves is not None  # most rows are stiff
            out.append(self.error(self.step(t, flat, _rows(held), u, _rows(moves)).view(x.shape), base) / by)
        self._take(self.theta)
        return self.passed(torch.stack(out, -1)) if out else x.new_zeros(*x.shape[:2], self.ne, 0)

    def pushed(self, x: Tensor, slopes: Tensor, after: Tensor | None = None) -> Tensor:
        """What unit forces on the disturbed ports do to a step (T, C, ne, nd), not yet `passed`; see `columns`."""
        if self.stiff is not None:
            return slopes[..., self.ne :]
        t, memory, u = self._in_the_middle()
        middle = _rows(self.midway(x, after))
        return self._to_the_end(self._pushed_by(middle, t, memory, u, range(self.ne, self.n)), slopes)

    def _to_the_end(self, moved: Tensor, slopes: Tensor) -> Tensor:
        """What a step does (T C, ne, k), of the rate in its middle, carried to its end (T, C, ne, k)."""
        out = torch.baddbmm(moved, _rows(slopes[..., : self.ne]), moved, beta=0.5, alpha=0.5)
        return out.view(*slopes.shape[:2], *out.shape[1:])

    def _in_the_middle(self) -> tuple[Tensor, Tensor, Tensor]:
        """Time of the middle of each step, memory and input over it, as rows."""
        t, memory, u = map(_rows, (self.chunks.t, self.memory, self.chunks.u))
        return t + 0.5 * self.logged_h, memory, u

    def missed(self, x: Tensor, after: Tensor) -> Tensor:
        """By how much steps from states (T, C, nx) to others, undisturbed, miss the next rows (T, C, ne)."""
        gap = self.error(after[:-1], x[1:])
        gap = torch.cat((gap, torch.zeros_like(gap[:1])))
        if not self.band:
            return gap
        y = self.states(self.chunks.y)
        moved = self.error(self.after(y).flatten(0, 1), y.flatten(0, 1)).view_as(gap)
        return gap - (moved - self.passed(moved))

    def passed(self, steps: Tensor) -> Tensor:
        """What is done to steps (T, C, ne, ...), as it is seen in states that were smoothed."""
        if not self.band:
            return steps
        out, row = steps.clone(), self.chunks.row
        for hz, which in self._of_band():
            series = steps.new_zeros(len(self.steps), len(which), *steps.shape[3:])
            series[row] = steps[:, :, which]
            for a, b in self.steps.segments:
                series[a:b] = low_passed(series[a:b], hz, self.h)
            out[:, :, which] = series[row]
        return out

    def low_passed_rows(self, rows: Tensor) -> Tensor:
        """Slopes in what is done to steps (T, C, ne, ...) from those in what is seen of it; the filter has no phase."""
        out = rows.clone() if self.band else rows
        for hz, which in self._of_band():
            out[:, :, which] = low_passed(rows[:, :, which], hz, self.h)
        return out

    def _of_band(self) -> list[tuple[float, list[int]]]:
        """Frequencies above which errors were smoothed away [Hz], and the numbers of these errors."""
        return [(hz, [i for i, own in self.band.items() if own == hz]) for hz in set(self.band.values())]
