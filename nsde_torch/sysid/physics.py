"""What the declared physics says of each step between samples, its slopes in the parameters, and how much it explains.

    residual_k = (x_{k+1} - x_k) - int f(x(t), u_k; theta) dt            over the step from t_k to t_{k+1}

is the weak form with boxes for test functions. The integral is Simpson's; the state in the middle is that of the
Hermite cubic through both ends, x_m = (x_0 + x_1) / 2 + h / 8 (f_0 - f_1), which is of fourth order. Slopes are those
at a state foreseen by the model from some steps earlier, the instruments of the regression (Soderstrom and Stoica,
Instrumental Variable Methods, 1983); white sensor noise s shifts the mean of a curved f by s^2 f'' / 2, which is taken
off by second differences (docs/content/theory/identification.md).

Rates that no sensor measured are inferred from positions that came before (`identify`). Then the residual is that
of the second difference of the position, whose test function is a hat over two steps,

    residual_k = (q_{k+1} - 2 q_k + q_{k-1}) / h - (I_{k-1} + I_k) / 2,      I_k = int f dt over step k

(over boxes of several steps, that of as wide a difference), with f at what the past predicts, averaged over what it
does not know of the rate: the noise of the position is then in no regressor. Velocities that the system measures in the
world are turned into the body, so that thrust along the body's axis is one channel and forces sideways are others.

How much of each measured rate the physics explains is said in means over test functions,

    mean rate = sum_k phi_k (x_{k+1} - x_k) / (h sum_k phi_k),        phi a smooth bump (Hann)

Over single steps sensor noise hides everything; over a quarter of a second it mostly does not.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, final

import numpy as np
import torch
from scipy.signal import lfilter
from torch import Tensor

from nsde_torch.arrays import Array, Labels
from nsde_torch.columns import join_columns, split_columns, take_rows
from nsde_torch.data.system_info import rate_pairs
from nsde_torch.effects import Port
from nsde_torch.inference.steps import Steps, data_sizes, memory_along, memory_as_measured, memory_moves
from nsde_torch.rotation import rotate_back, rotation_between
from nsde_torch.sde.exponential import exponentials, is_stiff, jacobians, stiff_change
from nsde_torch.sysid.noise import Noise
from nsde_torch.systems.parameters import ParameterVector

Forces = Callable[[Tensor], Mapping[Port, Tensor]]
_LEAD = 5  # steps from which a state is foreseen: sensor noise of one step biases, that of older ones hardly
_SMALL = 1e-7  # of a parameter's scale: slopes by forward differences err by as much
_SLOPE_ROWS = 5000  # of the data, evenly chosen, that means of slopes in the state are taken over
_STIFF_ROWS = 500  # that say whether it is stiff
_FOURTH = 70.0  # C(8, 4): variance of a fourth difference of white noise


@final
class Physics:
    """Residuals of steps as a function of theta.

    Args:
        curved: Whether sensor noise is white and f is to be corrected for its curvature.
        foresee: Whether slopes are those at a foreseen state; False takes the measured one.

    Attributes:
        names, units: Of the channels (the states' own; `(body)` where turned).
    """

    def __init__(
        self, vector: ParameterVector, steps: Steps, *, curved: bool = False, foresee: bool = True
    ) -> None:
        self.vector, self.steps, self.curved = vector, steps, curved
        vector.follow(steps.dt)
        vector.limit(data_sizes(vector.system, steps))
        vector.measure(*steps.some())
        self._lead = _LEAD if foresee else 0
        system = vector.system
        self.names, self.units = list(system.state_names), list(system.state_units)
        at = [self.names.index(v) for _, v, frame in system.position_derivatives if frame == "world"]
        self.turned: slice | None = None
        """Columns of a velocity in the world, of a system that knows its attitude."""
        if system.quaternion is not None and len(at) == 3 and at == list(range(at[0], at[0] + 3)):
            self.turned = slice(at[0], at[0] + 3)
            for i in at:
                self.names[i] += " (body)"
        self._starts = steps.starts
        inferred = {j for j, _ in steps.inferred}
        self.tied = tuple(i for i, j in rate_pairs(system) if j in inferred)
        """Columns of positions whose rates were inferred from them: their residuals say nothing."""
        self.sensor_std: Array = np.zeros(system.nx)
        """Standard deviation of white sensor noise (nx,), as the last `estimate_sensors` found it."""
        self._stiff: tuple[Tensor, bool] | None = None
        self._remembered: tuple[Tensor, tuple[Tensor, ...]] | None = None
        self._foreseen: tuple[Tensor, Tensor] | None = None
        self._forces: Forces | None = None

    def beside(self, forces: Forces) -> "Physics":
        """The same with forces that no parameter has: of a state (N, nx), by port (N, width)."""
        out = copy.copy(self)
        out._forces, out._foreseen = forces, None
        return out

    def with_inputs(self, u: Tensor) -> "Physics":
        """The same under other inputs and exogenous channels (N, nu + n)."""
        out = copy.copy(self)
        out.steps, out._foreseen, out._remembered = replace(self.steps, u=u), None, None
        return out

    def _drift(self, t: Tensor, z: Tensor, u: Tensor) -> Tensor:
        """f, with what acts beside it."""
        system = self.vector.system
        if self._forces is None:
            return system.drift(t, z, u)
        x, _ = split_columns(z, system.nx, z.shape[1] - system.nx)
        return system.drift(t, z, u, self._forces(x))

    @cached_property
    def attitude(self) -> Tensor:
        """Attitude in the middle of each step (N, 4); of a system that has none (N, 0)."""
        q = self.vector.system.quaternion
        if q is None:
            return torch.zeros(len(self.steps), 0)
        both = self.steps.x0[:, q] + self.steps.x1[:, q]
        return both / both.norm(dim=1, keepdim=True)

    @cached_property
    def measured(self) -> Array:
        """What was measured to change over each step (N, nx)."""
        return np.asarray(self.turn(self.steps.seen1 - self.steps.seen0, self.attitude))

    @torch.no_grad()
    def residual(self, theta: Array) -> Array:
        """Measured minus predicted change over each step (N, nx)."""
        at = torch.as_tensor(theta)
        return self.measured - self._hat(self._change(at, *self._memory(at)).numpy())

    @torch.no_grad()
    def slopes(self, theta: Array, which: Sequence[int] | None = None) -> Array:
        """Slopes of the predicted change in each parameter, or in `which` (N, nx, k), from what was known before it."""
        at = torch.as_tensor(theta)
        middle = self.middle(theta)
        before = self._forecast(at, middle)
        nx = self.vector.system.nx
        numbers = range(len(at)) if which is None else which
        out = np.empty((nx, len(numbers), len(before)))  # of each channel and parameter in one piece
        sizes = self.vector.size(theta)
        for i, j in enumerate(numbers):
            direction, moved = torch.zeros_like(at), middle
            direction[j] = 1.0
            # differences: forward mode takes ten times as long as the function
            small = _SMALL * float(sizes[j])
            if self.vector.moves_memory[j] and middle.shape[1] > nx:
                moved = middle.clone()
                moved[:, nx:] += small * self._memory_slope(at, j)
            change = (self._forecast(at + small * direction, moved) - before) / small
            out[:, i] = self.in_channels(change, middle).numpy().T
        self.vector.use(at)
        return self._hat(out.transpose(2, 0, 1))

    @torch.no_grad()
    def middle(self, theta: Array) -> Tensor:
        """State and memory in the middle of each step, as foreseen from some steps earlier (N, nz)."""
        at = torch.as_tensor(theta)
        if self._foreseen is None or not torch.equal(self._foreseen[0], at):
            self._foreseen = (at.clone(), self._foresee(at, *self._memory(at)))
        return self._foreseen[1]

    def in_channels(self, change: Tensor, states: Tensor) -> Tensor:
        """Changes of states (N, nx) in the channels of the residuals, at the attitude of some states (N, nz)."""
        q = self.vector.system.quaternion
        return change if q is None else self.turn(change, states[:, q])

    def kinematic(self, residual: Array, rows: Labels) -> Array:
        """Residuals (N, m) of the channels beside `rows`; attitude and position of a turned velocity in the body."""
        system, q, parts = self.vector.system, self.vector.system.quaternion, []
        rest = [i for i in range(residual.shape[1]) if i not in {*rows.tolist(), *self.tied}]
        if q is not None and set(range(q.start, q.stop)) <= set(rest):
            rest = [i for i in rest if not q.start <= i < q.stop]
            after = self.attitude + torch.as_tensor(residual[:, q])
            parts.append(rotation_between(self.attitude, after).numpy())
        if self.turned is not None:
            names = list(system.state_names)
            at = [names.index(p) for p, _, frame in system.position_derivatives if frame == "world"]
            if set(at) <= set(rest):
                rest = [i for i in rest if i not in at]
                parts.append(rotate_back(self.attitude, torch.as_tensor(residual[:, at])).numpy())
        return np.concatenate([residual[:, rest], *parts], 1)

    def estimate_sensors(self, residual: Array) -> None:
        """Take the white noise of the sensors from fourth differences of the residuals of the physics."""
        thirds = [np.diff(residual[a:b], 3, axis=0) for a, b in self.steps.segments if b - a > 3]
        if thirds:
            self.sensor_std = np.sqrt(np.square(np.concatenate(thirds)).mean(0) / _FOURTH)

    def state_slopes(self, theta: Array) -> tuple[Array, Array]:
        """Mean (nx,) of d f_i / d x_i and mean square (nx, nx) of d f_i / d x_j over the steps [1/s]."""
        slopes = self._state_slopes(theta)
        return slopes.mean(0).diagonal().copy(), np.square(slopes).mean(0)

    def left_after_a_step(self, theta: Array) -> Array:
        """Share that its own damping leaves of what a state is off by (nx,), the mean over the steps; 1 at most.

        Of a dry friction, which is steep where it turns, the mean slope says little of the other rows.
        """
        own = self._state_slopes(theta).diagonal(axis1=1, axis2=2)
        return np.exp(np.minimum(own, 0.0) * self.steps.dt).mean(0)

    @torch.no_grad()
    def _state_slopes(self, theta: Array) -> Array:
        """d f_i / d x_j at some of the steps (n, nx, nx) [1/s]."""
        at = torch.as_tensor(theta)
        system, s = self.vector.system, self.steps
        some = torch.linspace(0, len(s) - 1, min(len(s), _SLOPE_ROWS)).long()
        memory = [take_rows(part, some) for part in self._memory(at)[:1]]
        t, x, u = s.t[some], take_rows(s.x0, some), take_rows(s.u, some)
        self.vector.use(at)

        def rate(x: Tensor) -> Tensor:
            return system.drift(t, join_columns((x, *memory)), u)[:, : system.nx]

        out, before = np.zeros((len(some), system.nx, system.nx)), rate(x)
        for j in range(system.nx):
            moved = x.clone()
            small = _SMALL * max(1.0, float(x[:, j].abs().max()))
            moved[:, j] += small
            out[:, :, j] = ((rate(moved) - before) / small).numpy()
        return out

    @torch.no_grad()
    def linear(self, theta: Array) -> bool:
        """Whether f is linear in the parameters, as far as moving all of them by a tenth of their size shows."""
        at, s, v = torch.as_tensor(theta), self.steps, self.vector
        if v.moves_memory.any():
            return False
        away = torch.as_tensor(v.inside(theta + 0.1 * v.scale))
        some = torch.linspace(0, len(s) - 1, min(len(s), 2000)).long()
        rates = []
        for values in (at, 0.5 * (at + away), away):
            v.use(values)
            rates.append(v.system.drift(s.t[some], s.x0[some], s.u[some]))
        bend, change = rates[0] + rates[2] - 2.0 * rates[1], rates[2] - rates[0]
        return bool(bend.abs().max() <= 1e-9 * change.abs().max())

    def _memory(self, theta: Tensor) -> tuple[Tensor, ...]:
        """Memory of the effects at both ends of each step; nothing where none has any."""
        if self._remembered is None or not torch.equal(self._remembered[0], theta):
            self._remembered = (theta.clone(), self._memory_at(theta))
        return self._remembered[1]

    def _memory_at(self, theta: Tensor) -> tuple[Tensor, ...]:
        self.vector.use(theta)
        system = self.vector.system
        if system.nz == system.nx:
            return ()
        memory = memory_along(system, self.steps)
        own, measured = system.memory_columns(system.estimated_effects), torch.from_numpy(self.measured)
        if not own:
            return memory
        return memory_as_measured(
            system, self.steps, memory, own, lambda *there: measured - self._change(theta, *there)
        )

    def _change(self, theta: Tensor, *memory: Tensor) -> Tensor:
        """Predicted change over each step (N, nx)."""
        self.vector.use(theta)
        system, s = self.vector.system, self.steps
        if self.is_stiff(theta):  # what was measured after a step says nothing of the way there
            every = torch.arange(len(s))
            if not memory:
                return stiff_change(self._with_memory(every, ()), s.x0, s.dt)
            # what settles within a row follows what memory does in it
            mean, moves = 0.5 * (memory[0] + memory[1]), memory[1] - memory[0]
            moves = torch.where(moves == 0.0, memory_moves(system, s)[0], moves)
            first, last = (self._with_memory(every, (mean + k * moves,))(s.x0) for k in (-0.5, 0.5))
            return stiff_change(self._with_memory(every, (mean,)), s.x0, s.dt, turns=last - first)
        z0, z1 = s.x0, s.x1
        if memory:
            z0, z1 = join_columns((z0, memory[0])), join_columns((z1, memory[1]))
        f0 = self._rate(s.t, z0, 1.0)
        for j, _ in s.inferred:  # the rate after the step knows its noise: from the one before
            z1 = z1.clone()
            z1[:, j] = z0[:, j] + s.dt * f0[:, j]
        f1 = self._rate(s.t + s.logged_dt, z1, 1.0)
        middle = system.project(0.5 * (z0 + z1) + (s.dt / 8) * (f0 - f1))
        fm = self._rate(s.t + 0.5 * s.logged_dt, middle, 0.5)
        change = (s.dt / 6) * (f0 + 4.0 * fm + f1)[:, : system.nx]
        return self.turn(change, self.attitude)

    def is_stiff(self, theta: Tensor) -> bool:
        """Whether something settles in hardly more than a step under the values in use; see `sde.exponential`."""
        if self.vector.system.quaternion is not None:
            return False
        if self._stiff is None or not torch.equal(self._stiff[0], theta):
            s = self.steps
            some = torch.linspace(0, len(s) - 1, min(len(s), _STIFF_ROWS)).long()
            x = take_rows(s.x0, some)
            rate = self._with_memory(
                some, (self.vector.system.augment(x, take_rows(s.u, some))[:, x.shape[1] :],)
            )
            self._stiff = theta.clone(), is_stiff(s.dt * jacobians(rate, x))
        return self._stiff[1]

    def _with_memory(self, at: Tensor, memory: tuple[Tensor, ...]) -> Callable[[Tensor], Tensor]:
        """Rates of states (N, nx) in the middle of the steps `at` (N,), memory held."""
        s, nx = self.steps, self.vector.system.nx
        t, u = s.t[at] + 0.5 * s.logged_dt, take_rows(s.u, at)
        return lambda x: self._drift(t, join_columns((x, *memory)), u)[:, :nx]

    def _rate(self, t: Tensor, z: Tensor, share: float) -> Tensor:
        """f at measured states, without what noise of `share` of the sensors' variance adds to its mean."""
        u = self.steps.u
        plain = self._drift(t, z, u)
        f = self._averaged(plain, t, z, u)
        if not self.curved:
            return f
        inferred = {j for j, _ in self.steps.inferred}
        bend = torch.zeros_like(f)
        for j, std in enumerate(self.sensor_std.tolist()):
            if std > 0 and j not in inferred:
                bend = bend + self._bend(plain, t, z, u, j, std * share**0.5)
        return f - 0.5 * bend

    def _averaged(self, f: Tensor, t: Tensor, z: Tensor, u: Tensor) -> Tensor:
        """f averaged over what is not known of inferred rates (Gauss and Hermite's rule of three points)."""
        mean = f
        for j, std in self.steps.inferred:
            if std > 0:
                mean = mean + self._bend(f, t, z, u, j, std * 3.0**0.5) / 6.0
        return mean

    def _bend(self, f: Tensor, t: Tensor, z: Tensor, u: Tensor, j: int, by: float) -> Tensor:
        """Second difference of f in one state."""
        drift, shift = self._drift, torch.zeros_like(z)
        shift[:, j] = by
        return drift(t, z + shift, u) + drift(t, z - shift, u) - 2.0 * f

    def _hat(self, change: Array) -> Array:
        """Changes over steps (N, nx, ...), those of inferred rates as the differences weigh them."""
        if not self.steps.inferred:
            return change
        out = np.array(change)
        columns, rows = [j for j, _ in self.steps.inferred], self.steps.rows
        weights = np.convolve([0.5, 0.5], np.full(rows, 1.0 / rows))
        for a, b in self.steps.segments:
            there = lfilter(weights, [1.0], np.ones(b - a))  # less where a stretch begins
            summed = lfilter(weights, [1.0], change[a:b, columns], axis=0)
            out[a:b, columns] = summed / there.reshape(-1, *(1,) * (summed.ndim - 1))
        return out

    def _forecast(self, theta: Tensor, middle: Tensor) -> Tensor:
        """Change over each step by the midpoint rule (N, nx), at states (N, nz) that are held as theta moves."""
        self.vector.use(theta)
        system, s = self.vector.system, self.steps
        t = s.t + 0.5 * s.logged_dt
        if self.is_stiff(theta):
            x, memory = split_columns(middle, system.nx, middle.shape[1] - system.nx)
            rate = self._with_memory(torch.arange(len(s)), (memory,))
            one, _, _ = exponentials(s.dt * jacobians(rate, x))
            return s.dt * torch.einsum("nij,nj->ni", one, rate(x))
        return s.dt * self._averaged(self._drift(t, middle, s.u), t, middle, s.u)[:, : system.nx]

    def _memory_slope(self, theta: Tensor, j: int) -> Tensor:
        """Derivative of the memory in the middle of each step (N, nz - nx) in parameter j."""
        # by differences: a loop over time is slow in forward mode, and smooth in theta
        small = 1e-5 * float(self.vector.size(theta.numpy())[j])
        aside = torch.zeros_like(theta)
        aside[j] = small
        ends = zip(self._memory_at(theta + aside), self._memory_at(theta - aside), strict=True)
        moved: Tensor = sum(high - low for high, low in ends)  # type: ignore[assignment]
        return moved / (4.0 * small)

    def _foresee(self, theta: Tensor, *memory: Tensor) -> Tensor:
        """State in the middle of each step as the model foresees it from `_LEAD` steps earlier, and memory (N, nz)."""
        self.vector.use(theta)
        s = self.steps
        rows = torch.arange(len(s))
        if not self._lead:
            x = self.vector.system.project(0.5 * (s.x0 + s.x1))
            return join_columns((x, 0.5 * (memory[0] + memory[1]))) if memory else x
        stiff = self.is_stiff(theta)
        x = take_rows(s.x0, torch.maximum(rows - self._lead, self._starts))
        for back in range(self._lead, 0, -1):
            at = rows - back
            live = (at >= self._starts)[:, None]
            x = torch.where(live, self._later(x, torch.maximum(at, self._starts), memory, 1.0, stiff), x)
        x = self._later(x, rows, memory, 0.5, stiff)
        return join_columns((x, 0.5 * (memory[0] + memory[1]))) if memory else x

    def _later(self, x: Tensor, at: Tensor, memory: tuple[Tensor, ...], share: float, stiff: bool) -> Tensor:
        """States (N, nx) a share of a step later, by the midpoint rule, with inputs and memory of the steps `at`."""
        system, s = self.vector.system, self.steps
        t, u, h = s.t[at], take_rows(s.u, at), share * s.dt
        held = tuple(take_rows(part, at) for part in memory[:1])
        if stiff:
            return system.project(x + stiff_change(self._with_memory(at, held), x, h))
        z = join_columns((x, *held))
        middle = system.project(z + (0.5 * h) * self._drift(t, z, u))
        rate = self._drift(t + 0.5 * share * s.logged_dt, middle, u)
        return system.project(x + h * rate[:, : system.nx])

    def turn(self, change: Tensor, attitude: Tensor) -> Tensor:
        """Changes (N, nx) with a velocity in the world turned into the body."""
        if self.turned is None:
            return change
        a, b = self.turned.start, self.turned.stop
        before, v, after = split_columns(change, a, b - a, change.shape[1] - b)
        return join_columns((before, rotate_back(attitude, v), after))


BUMP_S, FEWEST = 0.25, 8


@dataclass(frozen=True)
class Channel:
    """How well one channel is explained, in means over test functions (bumps) of `width_s`."""

    name: str
    unit: str
    measured: float  # standard deviation of the measured rate
    residual: float  # root mean square of its residual
    sensor: float  # what white sensor noise alone leaves
    r2: float  # share of the variance that is explained
    noise: Noise | None  # law of the noise over single steps; None where the method has none

    def as_dict(self) -> dict[str, Any]:
        law = self.noise and {"carry": self.noise.carry, "order": len(self.noise.reflection)}
        return {
            "unit": self.unit,
            "measured_std": self.measured,
            "residual_rms": self.residual,
            "sensor_rms": self.sensor,
            "r2": self.r2,
            **({} if law is None else {"noise": law}),
        }


def bump(dt: float, pace: float = 1.0) -> Array:
    """The test function over steps of `dt` [s], of sum 1, for machines of a pace (`nsde_torch.data.pace`)."""
    n = max(FEWEST, round(BUMP_S * pace / dt))
    window = np.hanning(n + 2)[1:-1]
    return np.asarray(window / window.sum())


def smooth_rate(change: Array, segments: Sequence[tuple[int, int]], window: Array, dt: float) -> Array:
    """Mean rates (M, n) of changes over steps (N, n), wherever the test function fits into a segment."""
    parts = [
        np.stack([np.convolve(column, window, "valid") for column in change[a:b].T], 1) / dt
        for a, b in segments
        if b - a >= len(window)
    ]
    return np.concatenate(parts) if parts else np.zeros((0, change.shape[1]))


def explained(physics: Physics, residual: Array, rows: Labels, window: Array) -> list[Channel]:
    """Figures of the channels `rows`, of their residual changes over steps (N, len(rows)), in means over a window."""
    s = physics.steps
    measured = smooth_rate(physics.measured[:, rows], s.segments, window, s.dt)
    left = smooth_rate(residual, s.segments, window, s.dt)
    bend = np.sqrt(np.square(np.diff(window, prepend=0.0, append=0.0)).sum()) / s.dt
    out = []
    for i, c in enumerate(rows):
        std = float(measured[:, i].std()) if len(left) else 0.0
        rms = float(np.sqrt(np.square(left[:, i]).mean())) if len(left) else 0.0
        r2 = 1.0 - (rms / std) ** 2 if std > 0 else 0.0
        sensor = float(bend * physics.sensor_std[c])
        out.append(Channel(physics.names[c], per_second(physics.units[c]), std, rms, sensor, r2, None))
    return out


def per_second(unit: str) -> str:
    """Unit of a rate of something."""
    return f"{unit}2" if unit.endswith("/s") else f"{unit}/s"
