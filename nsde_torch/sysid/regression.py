"""Least-squares identification of declared physics from runs (docs/content/theory/identification.md).

Weak form with boxes of one step for test functions (`physics`), whitened by a law of the noise of every channel that
comes from the residuals themselves (`noise`); theta and the laws are found in turn,

    theta <- theta + argmin_d sum_i | P_i (r_i(theta) - J_i d) |^2,        P_i <- noise model of r_i(theta)

until theta moves by less than a fiftieth of its standard error; first with the law of sensor noise alone until theta
is within its standard error. These are Gauss-Newton steps, halved while they do not pay; one per law is exact where the
drift is linear in theta. The covariance (`spread`) counts that P was fitted too: where an input reacts to noise, theta
and P are not independent.

With X the whitened slopes, a direction d is lost where |X d| is nothing: beside rounding (a singular value of the
columns scaled to equal length below 1e-5 of the largest, since inputs are often logged in single precision), or
beside the noise (it could move by a thousand typical sizes unseen). No step is made along what is lost (`shown`).

Narrow shapes, such as the width at which a friction is developed, are kept within a few times the sizes of the data
(`ParameterVector.limit`). A fit that ends at such a bound is biased in what the width trades with by more than its
interval, so the bound is moved from there, and the fit goes on while that leads anywhere (`narrower`).

Assumed, not checked: an input or a first state moves the system, and not noise alone (a decay can also be one of the
noise), and inputs are those that acted (smoothed ones lose against a noise model: take `differences`).
"""

import copy
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import inf
from typing import final

import numpy as np
from scipy.optimize import lsq_linear

from nsde_torch.arrays import Array, Labels, Mask
from nsde_torch.data import Run
from nsde_torch.data.inputs import echelon
from nsde_torch.errors import ConfigError, DataError, NonFiniteError
from nsde_torch.inference.estimate import ARITHMETIC
from nsde_torch.inference.spread import Spread, spread
from nsde_torch.inference.steps import steps_of
from nsde_torch.models.identified import METHODS
from nsde_torch.sysid.noise import Noise, Series, again, carry_limit, estimate, extended, first_guess, past
from nsde_torch.sysid.physics import Physics
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector
from nsde_torch.time_limit import check_time

_SINGULAR = 1e-5
_UNSEEN = 1e3  # typical sizes
_PART = 0.05  # of the largest part of a direction: below that a parameter is left out of the sentence


@dataclass(frozen=True)
class Shown:
    """What the data show of theta."""

    basis: Array  # directions that are shown (k, r), in the units of theta
    lost: Array  # directions that are not (k, k - r), each with a largest part of one typical size
    known: Mask  # whether each parameter alone is shown (k,)
    condition: float  # largest over smallest singular value of the scaled slopes among the directions shown

    @property
    def rank(self) -> int:
        """Number of directions that are shown."""
        return self.basis.shape[1]


def shown(slopes: Array, scale: Array) -> Shown:
    """Directions that whitened slopes (N, k) show of parameters of typical sizes `scale` (k,)."""
    k = slopes.shape[1]
    length = np.linalg.norm(slopes, axis=0)
    dead = length * scale * _UNSEEN < 1.0
    live = np.flatnonzero(~dead)
    size = 1.0 / np.where(dead, 1.0, length)
    if not len(live):
        return Shown(np.zeros((k, 0)), np.diag(scale), np.zeros(k, dtype=bool), 1.0)
    triangle = np.linalg.qr(slopes[:, live] * size[live], mode="r")
    _, values, directions = np.linalg.svd(triangle)
    values = np.concatenate((values, np.zeros(len(live) - len(values))))
    # how many typical sizes the parameters go where the data see one standard deviation
    reach = (np.abs(directions) * (size / scale)[live]).max(1) / np.maximum(values, 1e-300)
    seen = (values > _SINGULAR * values[0]) & (reach < _UNSEEN)
    scaled = np.zeros((k, len(live)))
    scaled[live] = (directions * size[live]).T
    basis, lost = scaled.compress(seen, 1), scaled.compress(~seen, 1)
    readable = np.concatenate((np.diag(scale)[:, dead], _readable(lost, scale)), 1)
    known = ~dead
    known[live] &= np.square(directions[~seen]).sum(0) < 1e-6
    condition = float(values[seen][0] / values[seen][-1]) if seen.any() else 1.0
    return Shown(basis, readable, known, condition)


def _readable(directions: Array, scale: Array) -> Array:
    """The same space with as many zeros as pivoting gives, each direction with a largest part of one typical size."""
    rows = echelon((directions / scale[:, None]).T)
    largest = np.abs(rows).max(1, keepdims=True, initial=1e-300)
    return np.asarray((rows / largest).T * scale[:, None])


def sentences(found: Shown, labels: Sequence[str], units: Sequence[str], scale: Array) -> list[str]:
    """What the data cannot show, in words."""
    out = []
    for direction in found.lost.T:
        share = np.abs(direction) / scale
        parts = [i for i in np.argsort(-share) if share[i] > _PART * share.max()]
        if len(parts) == 1:
            out.append(f"{labels[parts[0]]}: nothing in the data depends on it")
            continue
        moves = ", ".join(f"{labels[i]} by {direction[i]:+.3g} {units[i]}" for i in sorted(parts))
        names = " and ".join(labels[i] for i in sorted(parts))
        out.append(f"{names}: only together; the data look the same with {moves}")
    return out


def bounded_step(
    slopes: Array, residual: Array, found: Shown, low: Array, high: Array, scale: Array
) -> Array:
    """The step d (k,) that minimises |residual - slopes d| with low <= d <= high, none of it along what is lost.

    Of whitened slopes (N, k) and residuals (N,), bounds (k,) that hold 0, and typical sizes `scale` (k,).
    """
    free = found.basis @ np.linalg.lstsq(slopes @ found.basis, residual, rcond=None)[0]
    if ((free >= low) & (free <= high)).all():
        return np.asarray(free)
    k = slopes.shape[1]
    triangle: Array = np.linalg.qr(np.column_stack((slopes, residual)), mode="r")  # type: ignore[assignment]
    size = max(float(np.abs(triangle[:k, :k] * scale).max()), 1.0)
    still = size * (found.lost / scale[:, None] ** 2).T  # rows that hold the step still along what is lost
    rows = np.concatenate((triangle[:k, :k], still)) * scale
    target = np.concatenate((triangle[:k, k], np.zeros(len(still))))
    result = lsq_linear(rows, target, bounds=(low / scale, high / scale), method="bvls")
    return np.asarray(np.clip(result.x * scale, low, high))


ITERATIONS = 20
_BOX_S = 0.01  # data on a shorter step are summed to about this
_ORDERS_S, _ORDERS = 0.4, 40  # longest autoregression [s], [steps]
_SETTLED = 0.02  # standard errors
_ROUGH = 8  # steps with the law of sensor noise alone, at most
_ROUNDING = 1e-4  # of the measured changes: below that there is no noise to speak of
_BLOCK_S = (0.5, 2.0)  # shortest and longest block of the covariance [s]
_BLOCKS = 100
_UNBOUNDED = 1e100  # largest slope: the squares of larger ones overflow
_KEPT = 1e-8  # share of the slopes that laws explain, from which they are kept


@final
class Regression:
    """The regression of one set of runs, whose pieces others may use: what a candidate effect would explain.

    Args:
        box: Steps per box.
        rows: Numbers of the channels to look at; None takes those that depend on a parameter.
        start: First theta; None takes the system's values.
        noises: Laws whose kind (order, c) is kept, one per channel of `rows`; None finds them.
        origin: The system that `physics` is of, for those who want it with other values.
        held: Labels of parameters that stay where they start.
        plain: Take the noise of every channel for white, as ordinary least squares does.
        warm: Start with the noise models at the first theta, where that is near its optimum.
        memory_s: Time after which noise forgets [s] (see `noise`).
        feedback: Take out of `white` and `slopes` what kinematic residuals predict (see `noise`).
        channels: With `feedback`: what the residuals of all channels predict.
        levels: Take the mean of each run out of `white` and `slopes`: a steady push is nobody's.

    Attributes:
        white, slopes: Whitened residuals (channels, N) and slopes (channels, N, k) at theta.
        shown: What the data show of theta, sizes per input counted from the median (`ParameterVector.references`).
    """

    def __init__(
        self,
        physics: Physics,
        *,
        box: int = 1,
        rows: Labels | None = None,
        start: Array | None = None,
        noises: Sequence[Noise] | None = None,
        origin: System | None = None,
        held: Collection[str] = (),
        plain: bool = False,
        feedback: bool = False,
        channels: bool = False,
        warm: bool = False,
        levels: bool = False,
        memory_s: float = inf,
    ) -> None:
        self._feedback, self._channels = feedback, channels
        self._past = np.zeros((0, 0))
        self.physics, self.box, self.origin, self._plain = physics, box, origin, plain
        self.held = np.array([label in held for label in physics.vector.labels])
        """Whether each parameter stays where it started (k,)."""
        self.vector = physics.vector
        self.single = Series(physics.steps.segments)
        self.series = self.single.boxes(box)
        self.dt, self.pace = physics.steps.dt * box, physics.steps.pace
        most = min(_ORDERS, max(len(self.series) // 50, 2))
        self.orders = int(np.clip(round(_ORDERS_S * self.pace / self.dt), 2, most))
        self.memory = memory_s / self.dt  # rows after which noise forgets
        if levels:
            owner = self.whitened_rows(self.owners)
            each = (owner[:, None] == np.unique(owner)[None, :]).astype(np.float64)
            self._past = each / np.sqrt(each.sum(0))
        self.theta = self.vector.inside(self.vector.start if start is None else start)
        """Where the iteration stands."""
        self.residual = self._residual(self.theta)
        self._relinearise()
        largest = np.abs(self.jacobian).max((0, 2))
        moving = np.flatnonzero(largest > 1e-12 * largest.max()) if largest.max() > 0 else np.arange(0)
        self.rows = moving if rows is None else rows
        if not len(moving):
            raise DataError(
                "no rate in these data depends on any declared parameter. Record runs in which the machine moves."
            )
        self.noises: list[Noise] = list(noises or [])
        self._kept = noises is not None
        self.iterations = 0
        self.converged = False
        # where theta starts near its optimum, the sensor's law alone could lead it away to another
        self._refined = 2 if warm else 0  # steps since laws are looked for
        self._rough = not (self._kept or plain or warm)
        self._whiten()

    def run(self, iterations: int) -> None:
        """Iterate until theta has settled, or this many times."""
        if iterations < 1:
            raise ConfigError(f"`max_iterations` must be at least 1; got {iterations}.")
        for _ in range(iterations):
            check_time()
            moved = self._step()
            self.iterations += 1
            settled = moved < (1.0 if self._rough else _SETTLED)
            if settled and (self._kept or self._rough or self._plain or self._refined > 4):
                self.converged = True
                break

    def _residual(self, theta: Array) -> Array:
        return self.single.summed(self.physics.residual(theta), self.box)

    def _relinearise(self) -> None:
        self.jacobian = self.single.summed(self.physics.slopes(self.theta), self.box)
        self.jacobian[..., self.held] = 0.0
        if np.abs(self.jacobian).max(initial=0.0) > _UNBOUNDED:
            raise NonFiniteError(
                f"what the declared physics predicts over {self.dt:.3g} s grows without bound: first values are far "
                "off, or rates that were inferred from positions diverge. Give other first values "
                "(system.parameters.NAME=...), log the rates, or record at a higher rate."
            )

    def carry_limits(self) -> Array:
        """Largest c of each channel (nx,): sensor noise reaches a rate through every state that it depends on."""
        physics = self.physics
        physics.estimate_sensors(physics.residual(self.theta))
        own, square = physics.state_slopes(self.theta)
        std = physics.sensor_std.copy()
        if physics.turned is not None:  # one sensor noise for a velocity that is turned
            std[physics.turned] = np.sqrt(np.square(std[physics.turned]).mean())
        others = square @ np.square(std) - np.diag(square) * np.square(std)
        known = physics.steps.dt * np.sqrt(self.box * others)
        return np.array([carry_limit(o, k, s, self.dt) for o, k, s in zip(own, known, std, strict=True)])

    def times(self, channel: int) -> int:
        """How many times the error of its sensor is differenced in a channel (see `noise`)."""
        return 2 if channel in {j for j, _ in self.physics.steps.inferred} else 1

    def _whiten(self) -> None:
        """Laws of the noise at theta, and everything in their units."""
        if self._refined < 3 and not (self._kept or self._plain):
            self.limits = self.carry_limits()
        noises = []
        for i, channel in enumerate(self.rows):
            r = self.residual[:, channel]
            if self._plain:
                noises.append(first_guess(r, self.series, 0.0))
            elif self._kept or self._refined > 3:
                # the same kind of law from here on, so that theta can settle
                noises.append(again(self.noises[i], r, self.series, memory=self.memory))
            elif self._rough:
                limit = float(self.limits[channel])
                noises.append(first_guess(r, self.series, limit, times=self.times(channel)))
            else:
                # theta first: an order would learn its errors
                orders = self.orders if self._refined > 1 else 1
                noises.append(self.law(channel, r, float(self.limits[channel]), orders))
        self.noises = noises
        if self._feedback and self._refined < 3:
            residual = self.physics.residual(self.theta)
            known = self.physics.kinematic(residual, self.rows)
            if self._channels:
                known = np.concatenate((known, residual[:, self.rows]), 1)
            self._past = past(self.single.summed(known, self.box), self.series, channels=self._channels)
        pairs = list(zip(noises, self.rows, strict=True))
        self.white = np.stack([self.whitened(n, self.residual[:, [c]])[:, 0] for n, c in pairs])
        self.slopes = np.stack([self.whitened(n, self.jacobian[:, c]) for n, c in pairs])
        finite = np.isfinite(self.slopes).all((1, 2)) & np.isfinite(self.white).all(1)
        if not finite.all():
            names = ", ".join(self.physics.names[c] for c in self.rows[~finite])
            raise NonFiniteError(
                f"what the declared physics leaves of {names} can be predicted to the last digit: the log is smoother "
                "than a sensor and the physics allow. Let smoothed states be restored (data.state_smoothing=restore), "
                "or resample to a longer step (data.dt)."
            )
        slopes = self.slopes.reshape(-1, len(self.vector))
        self.shown: Shown = shown(slopes, self.vector.scale)
        if references := self.vector.references(self.theta, self.shown.known):
            slopes = slopes.copy()
            slopes[:, references] = 0.0
            self.shown = shown(slopes, self.vector.scale)

    def _step(self) -> float:
        """One step of theta; returns its length in standard errors."""
        v, k = self.vector, len(self.vector)
        low, high = v.inside(np.full(k, -np.inf)) - self.theta, v.inside(np.full(k, np.inf)) - self.theta
        flat = self.slopes.reshape(-1, k)
        ends = low.clip(max=0), high.clip(min=0)
        step = bounded_step(flat, self.white.reshape(-1), self.shown, *ends, v.scale)
        before = float(np.square(self.white).sum())
        for _ in range(8):
            trial = v.inside(self.theta + step)
            residual = self._residual(trial)
            if np.isfinite(residual[:, self.rows]).all() and self._size(residual) <= 1.01 * before:
                break
            step = 0.5 * step
        else:
            if not np.isfinite(residual[:, self.rows]).all():
                raise NonFiniteError(
                    "the declared physics is not finite near "
                    + ", ".join(f"{n} = {t:.4g}" for n, t in zip(v.labels, trial, strict=True))
                    + ". Give other first values: system.parameters.NAME=..."
                )
        moved = float(np.linalg.norm(flat @ (trial - self.theta)) / max(self.shown.rank, 1) ** 0.5)
        self.theta, self.residual = trial, residual
        if moved > 1.0 or self._refined < 2:
            self._relinearise()
        self._rough = self._rough and (self._exact() or (moved > 1.0 and self.iterations + 1 < _ROUGH))
        self._refined += not self._rough
        self._whiten()
        return moved

    def _exact(self) -> bool:
        """Whether the physics leaves nothing but rounding."""
        measured = self.single.summed(self.physics.measured, self.box)[:, self.rows]
        left = np.array([n.std for n in self.noises])
        return bool((left <= _ROUNDING * np.sqrt(np.square(measured).mean(0))).all())

    @property
    def arithmetic(self) -> bool:
        """Whether the physics leaves no more than arithmetic does; of a simulation without noise nothing is missing."""
        measured, left = (values[:, self.rows] for values in (self.physics.measured, self.residual))
        return bool((np.square(left).mean(0) <= ARITHMETIC**2 * np.square(measured).mean(0)).all())

    @np.errstate(over="ignore")  # of a step that leads far off: it is halved
    def _size(self, residual: Array) -> float:
        pairs = zip(self.noises, self.rows, strict=True)
        return sum(float(np.square(self.whitened(n, residual[:, [c]])).sum()) for n, c in pairs)

    def whitened(self, noise: Noise, values: Array) -> Array:
        """Columns (N, k) in whitened rows, without what the past of other channels predicts."""
        return self._purged(noise.whiten(values, self.series))

    def _purged(self, values: Array) -> Array:
        return values - self._past @ (self._past.T @ values) if self._past.size else values

    # ---- results --------------------------------------------------------------------------------------

    @property
    def owners(self) -> Labels:
        """Number of the run of each row of `series` (M,)."""
        counts = [b - a for a, b in self.series.edges]
        return np.repeat(np.array(self.physics.steps.runs, dtype=np.int64), counts)

    @property
    def blocks(self) -> Labels:
        """Block of time of each row of `series` (M,)."""
        total = len(self.series) * self.dt
        length = self.pace * float(np.clip(total / self.pace / _BLOCKS, *_BLOCK_S))
        return self.series.blocks(max(1, round(min(length, total / 20) / self.dt)))

    def spread(self) -> Spread:
        """Covariance in the directions that are shown."""
        purged, used = self._beside_laws(self.shown.basis)
        return spread(purged, self.white, self.whitened_rows(self.blocks), used)

    def _beside_laws(self, basis: Array) -> tuple[Array, int]:
        """Slopes (channels, N, r) along directions (k, r) without what those of the laws explain, and how many do."""
        purged, used = [], 0
        for i, (noise, channel) in enumerate(zip(self.noises, self.rows, strict=True)):
            x = self.slopes[i] @ basis
            own = self._purged(noise.own_slopes(self.residual[:, channel], self.series))
            if own.shape[1]:
                # the rest keeps a direction that a law explains wholly: its variance is huge and finite
                x = x - (1.0 - _KEPT) * (own @ np.linalg.lstsq(own, x, rcond=None)[0])
            purged.append(x)
            used += own.shape[1] + self._past.shape[1]
        return np.stack(purged), used

    def at(self, theta: Array) -> "Regression":
        """The same at other values, with noise models of the same kind."""
        out = copy.copy(self)
        out.theta = theta
        out.residual = out._residual(theta)
        out._relinearise()
        out._rough, out._refined = False, 4
        out._whiten()
        return out

    def fitted_columns(self, row: int) -> Array:
        """Columns that the whitened residual of channel `row` of `rows` was fitted with: theta, its law, its past."""
        own = self.noises[row].own_slopes(self.residual[:, self.rows[row]], self.series)
        parts = [self.slopes[row] @ self.shown.basis, self._purged(own)]
        return np.concatenate([*parts, self._past] if self._past.size else parts, 1)

    def own_noises(self, orders: int) -> list[Noise]:
        """Laws of the noise of the residuals at theta, of whatever kind suits them, up to some order."""
        limits = self.carry_limits()
        return [self.law(c, self.residual[:, c], float(limits[c]), orders) for c in self.rows]

    def law(self, channel: int, left: Array, limit: float, orders: int) -> Noise:
        """Noise law of the residual of a channel (M,), its c up to a limit and its order up to another."""
        memory, times = self.memory, self.times(channel)
        return estimate(left, self.series, limit=limit, orders=orders, memory=memory, times=times)

    def under(self, row: int, law: Noise) -> "Regression":
        """The same with another noise model of channel number `row` of `rows`; theta stays."""
        out = copy.copy(self)
        out.noises, out.white, out.slopes = list(self.noises), self.white.copy(), self.slopes.copy()
        out.noises[row], channel = law, self.rows[row]
        out.white[row] = self.whitened(law, self.residual[:, [channel]])[:, 0]
        out.slopes[row] = self.whitened(law, self.jacobian[:, channel])
        return out

    def whitened_rows(self, labels: Labels) -> Labels:
        """Labels of the rows of `white` from those of the rows of `series`."""
        longer = extended(self.series)
        out = np.empty(len(longer), dtype=np.int64)
        for (a, b), (c, d) in zip(self.series.edges, longer.edges, strict=True):
            out[c], out[c + 1 : d] = labels[a], labels[a:b]
        return out

    def shift(self, parts: Array, blocks: Labels) -> Array:
        """Change of the residuals over steps (N, channels) when each block is predicted from the others alone.

        `parts` is what each block contributes to theta (C, k), `blocks` the block of each row of `series`.
        """
        of_step = np.empty(len(self.single), dtype=np.int64)
        for (a, b), (c, d) in zip(self.single.edges, self.series.edges, strict=True):
            of_step[a:b] = blocks[np.minimum(c + np.arange(b - a) // self.box, d - 1)]
        slopes = self.jacobian if self.box == 1 else self.physics.slopes(self.theta)
        return np.asarray(np.einsum("nck,nk->nc", slopes[:, self.rows], parts[of_step]))


def regression_of(
    system: System,
    runs: Sequence[Run],
    *,
    clock: float = 1.0,
    method: str = "weak",
    width: float | None = None,
    start: Array | None = None,
) -> Regression:
    """The regression of some runs, before its first step; `start` is its first theta, else as for `identify`."""
    if method not in METHODS:
        raise ConfigError(f"`method` must be {' or '.join(METHODS)}; got {method!r}.")
    weak = method == "weak"
    vector = ParameterVector(system)
    box = _box(width, runs[0].dt * clock, runs[0].pace) if runs else 1
    steps = steps_of(system, runs, clock=clock, smooth=not weak, shortest=box, differences=box if weak else 0)
    physics = Physics(vector, steps, curved=weak and system.sensor_noise, foresee=weak)
    return Regression(physics, box=box, start=start, plain=not weak, feedback=weak)


def _box(width: float | None, dt: float, pace: float) -> int:
    if width is not None and round(width / dt) < 1:
        raise ConfigError(
            f"`model.width` must be a step of the data ({dt:.4g} s) or longer; got {width:g} s."
        )
    return max(1, int(_BOX_S * pace / dt + 1e-6)) if width is None else round(width / dt)


# ---- narrow shapes -------------------------------------------------------------------------------------

MOVED = 0.5
"""Standard errors by which the fit must go on; what goes nearly nowhere says that narrower ones are all alike."""
_SHARE = 4.0  # by which a bound is moved at a time
_TIMES = 4  # then a width is a ten-thousandth of the usual speed, and nothing that is measured depends on it
_AT_BOUND = 1e-3  # of a parameter's scale


def narrower(regression: Regression, iterations: int) -> Regression:
    """The regression, or one that went on beyond lower bounds of shapes that only the search has."""
    v = regression.vector
    for _ in range(_TIMES):
        ends = np.flatnonzero(v.raised & (regression.theta <= v.low + _AT_BOUND * v.scale))
        if not ends.size:
            break
        bounds = v.low.copy()
        v.low[ends] /= _SHARE
        other = copy.copy(regression)
        other.run(iterations)
        slopes = 0.5 * (regression.slopes + other.slopes)
        if np.linalg.norm(slopes @ (other.theta - regression.theta)) < MOVED:
            v.low = bounds
            break
        regression = other
    return regression
