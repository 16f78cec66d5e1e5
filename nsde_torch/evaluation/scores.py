"""Scores of one model at every start and every horizon: what means over starts, and bootstraps, are made of.

With e = sample - measured in the system's error channels, over P particles, at one start and horizon:

    prediction   mean of the particles (quaternions: of the aligned and normalised ones)
    interval     quantiles of e at the plotting position p (P + 1): with 199 particles their ends are order
                 statistics, and a calibrated ensemble holds just these shares
    CRPS         the fair one, see `crps`
    NLL          ln(2 pi v) / 2 + m^2 / (2 v), with m and v the mean and the (unbiased) variance of e: the negative
                 log density of the measurement under a Gaussian of the particles' moments [nat]; not defined (NaN)
                 where v = 0, as for a model without noise
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.columns import few_operations
from nsde_torch.data import Windows
from nsde_torch.errors import NonFiniteError
from nsde_torch.models.identified import IdentifiedModel
from nsde_torch.models.model import Model, inputs_before, sampled
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector

LEVELS = (0.1, 0.25, 0.5, 0.75, 0.9, 0.95)
PARTICLES = 199  # every level of LEVELS falls on an order statistic; their mean adds 0.25 % to the error
BASELINES = ("hold", "constant_velocity")
_BATCH = 256


def crps(errors: Tensor) -> Tensor:
    """Fair CRPS (...) of errors, ensemble minus truth (P, ...); a point forecast, P = 1, scores its absolute error."""
    p = errors.shape[0]
    distance = errors.abs().mean(0)
    if p == 1:
        return distance
    ordered = errors.sort(0).values
    rank = torch.arange(1, p + 1, device=errors.device, dtype=errors.dtype)
    weight = (2 * rank - p - 1).reshape(p, *[1] * (errors.ndim - 1))
    return distance - (weight * ordered).sum(0) / (p * (p - 1))


def mean_state(system: System, samples: Tensor) -> Tensor:
    """Mean of particles (P, ..., nx) -> (..., nx); the quaternion aligned, averaged, normalised."""
    mean = samples.mean(0)
    if system.quaternion is None:
        return mean
    q = samples[..., system.quaternion]
    sign = torch.where((q * q[:1]).sum(-1, keepdim=True) < 0, -1.0, 1.0).to(q)
    q = (q * sign).mean(0)
    mean[..., system.quaternion] = q / q.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    return mean


def interval_quantiles(ordered: Tensor, level: float) -> tuple[Tensor, Tensor]:
    """Lower and upper end of the central interval of an ensemble (P, ...), in ascending order."""
    p = ordered.shape[0]

    def quantile(share: float) -> Tensor:
        at = min(max(share * (p + 1) - 1, 0.0), p - 1.0)
        low = int(at)
        high = min(low + 1, p - 1)
        return ordered[low] + (at - low) * (ordered[high] - ordered[low])

    return quantile((1 - level) / 2), quantile((1 + level) / 2)


def gaussian_nll(errors: Tensor) -> Tensor:
    """Negative log density of the truth under a Gaussian of the ensemble's mean and variance.

    Of ensemble minus truth (P, ...): (...) in float64 [nat, for a density in the unit of the errors]; NaN where the
    ensemble has no spread.
    """
    e = errors.double()
    variance = e.var(0, correction=min(1, len(e) - 1))
    nll = 0.5 * (math.log(2 * math.pi) + variance.log() + e.mean(0).square() / variance)
    return torch.where((errors == errors[:1]).all(0), math.nan, nll)  # rounding may leave a variance


def baselines(system: System, x0: Tensor, elapsed: float) -> dict[str, Tensor]:
    """States (B, nx) after `elapsed` seconds if the state, or the velocity, stayed as it is."""
    moving = x0.clone()
    names = list(system.state_names)
    for position, velocity, _ in system.position_derivatives:
        moving[:, names.index(position)] += elapsed * x0[:, names.index(velocity)]
    return {"hold": x0, "constant_velocity": moving}


def group_squares(system: System, errors: Tensor) -> Tensor:
    """Squared norm of each error group (..., n_groups) of errors (..., n_error), in the unit of the channels."""
    return torch.stack([g.squares(errors) for g in system.error_groups], -1)


def rms_by_group(system: System, squares: Tensor, horizons: Sequence[str]) -> dict[str, dict[str, float]]:
    """Root mean square over starts, of squared norms (S, horizons, groups): group -> horizon -> error, in its unit."""
    rms = squares.mean(0).sqrt()
    return {
        g.name: {h: float(rms[k, i]) * g.factor for k, h in enumerate(horizons)}
        for i, g in enumerate(system.error_groups)
    }


@dataclass(frozen=True)
class Scores:
    """Scores of the S starts from which a model stayed in the finite numbers."""

    system: System  # the system, for groups and channels
    starts: int  # number of starts tried
    kept: Tensor  # positions, among those tried, of the S starts (S,)
    squares: Tensor  # squared norms of the prediction's error (S, horizons, groups)
    inside: Tensor  # whether the intervals hold the measurement (S, horizons, levels, channels)
    crps: Tensor  # fair CRPS (S, horizons, channels)
    spread: Tensor  # standard deviation of the particles (S, horizons, channels)
    nll: Tensor  # Gaussian negative log likelihood (S, horizons, channels), NaN where there is no spread

    @property
    def diverged(self) -> int:
        """Starts without a finite prediction."""
        return self.starts - len(self.kept)

    @property
    def stochastic(self) -> bool:
        """Whether any channel ever has a spread."""
        return bool((self.spread > 0).any())

    def at(self, rows: Tensor) -> "Scores":
        """The scores of some of the S starts alone, by row."""
        names = ("kept", "squares", "inside", "crps", "spread", "nll")
        return replace(self, starts=len(rows), **{name: getattr(self, name)[rows] for name in names})


@torch.no_grad()
def score(
    model: Model,
    windows: Windows,
    starts: Tensor,
    steps: Sequence[int],
    *,
    seed: int,
    particles: int = PARTICLES,
    dt: float | None = None,
    compile: bool = False,
    measurement_std: Tensor | None = None,
) -> Scores:
    """Score a model from starts, by window numbers (B,), at horizons [model steps].

    `dt` is the step on the clock of the training data [s] if it is not the model's own, and `measurement_std` the
    sensor noise of these runs (nx,) if it is not that of the training data.
    """
    system = model.system
    generator = torch.Generator().manual_seed(seed)
    rows: list[tuple[Tensor, ...]] = []
    kept: list[Tensor] = []
    parts = list(torch.arange(len(starts)).split(_BATCH))
    while parts:
        part = parts.pop(0)
        try:
            x, samples, _ = sampled(
                model,
                windows,
                starts[part],
                particles=particles,
                generator=generator,
                dt=model.spec.dt if dt is None else dt,
                compile=compile,
                measurement_std=measurement_std,
            )
        except NonFiniteError:
            if len(part) > 1:  # look for those at fault; the others are scored
                parts[:0] = part.chunk(2)
            continue
        kept.append(part)
        made = [_of_horizon(system, samples[:, :, k], x[:, k]) for k in steps]
        rows.append(tuple(torch.stack(column, 1).cpu() for column in zip(*made, strict=True)))
    if not rows:
        h, c, g = len(steps), len(system.error_names), len(system.error_groups)
        tails = ((g,), (len(LEVELS), c), (c,), (c,), (c,))
        rows = [tuple(torch.empty(0, h, *tail) for tail in tails)]
        kept = [torch.empty(0, dtype=torch.long)]
    joined = (torch.cat(column) for column in zip(*rows, strict=True))
    return Scores(system, len(starts), torch.cat(kept), *joined)


def baseline_squares(
    system: System, windows: Windows, starts: Tensor, steps: Sequence[int]
) -> dict[str, Tensor]:
    """Squared norms of the errors of the baselines from starts (B,): name -> (B, horizons, groups)."""
    parts: dict[str, list[Tensor]] = {name: [] for name in BASELINES}
    for part in starts.split(_BATCH):
        x = windows.batch(part)[0]
        still = [baselines(system, x[:, 0], k * windows.dt_model) for k in steps]
        for name, rows in parts.items():
            errors = (system.error(s[name], x[:, k]) for s, k in zip(still, steps, strict=True))
            rows.append(torch.stack([group_squares(system, e) for e in errors], 1).cpu())
    return {name: torch.cat(rows) for name, rows in parts.items()}


def _of_horizon(system: System, sample: Tensor, y: Tensor) -> tuple[Tensor, ...]:
    """Squares, inside, CRPS, spread and NLL at one horizon."""
    squares = group_squares(system, system.error(mean_state(system, sample), y))
    e = system.error(sample, y.expand_as(sample))
    ordered = e.sort(0).values
    ends = (interval_quantiles(ordered, level) for level in LEVELS)
    inside = [(low <= 0) & (high >= 0) for low, high in ends]
    # equal particles have no spread, whatever rounding makes of their errors
    alike = (e == e[:1]).all(0) | (sample == sample[:1]).flatten(2).all(2).all(0)[:, None]
    spread = e.std(0, correction=min(1, len(e) - 1)).masked_fill(alike, 0.0)
    return (squares, torch.stack(inside, 1), crps(e), spread, gaussian_nll(e).masked_fill(alike, math.nan))


@torch.no_grad()
def rollout_squares(model: IdentifiedModel, windows: Windows, starts: Tensor, steps: Sequence[int]) -> Tensor:
    """Squared errors (S, horizons, groups) of predictions by Runge and Kutta; not finite where one diverged.

    A prediction that leaves the finite numbers does so alone, and does not stop the others.
    """
    states = _advanced(model, windows.dt_model, steps, *_begun(model, windows, starts))
    return squares_of(model.system, states, windows, starts, steps)


def squares_of(
    system: System, states: Tensor, windows: Windows, starts: Tensor, steps: Sequence[int]
) -> Tensor:
    """Squared errors (S, horizons, groups) of predicted states (S, horizons, nx)."""
    return group_squares(system, system.error(states, windows.batch(starts)[0][:, list(steps)]))


@torch.no_grad()
def states_by_fold(
    model: IdentifiedModel,
    windows: Windows,
    starts: Tensor,
    steps: Sequence[int],
    *,
    values: NDArray[np.float64],
    fold: NDArray[np.int64],
) -> Tensor:
    """Predicted states (S, horizons, nx) as `rollout_squares` has them, with values for each `fold` of the starts (S,).

    The values are those of a `ParameterVector` (folds, k).
    """
    vector = ParameterVector(model.system)
    model.system, thetas, begun = vector.system, torch.from_numpy(values), []
    rows = [np.flatnonzero(fold == f) for f in range(len(thetas))]
    most = max(map(len, rows))
    for own, theta in zip(rows, thetas, strict=True):
        vector.use(theta)
        begun.append(_begun(model, windows, starts[np.resize(own, most)]))

    def one(theta: Tensor, *parts: Tensor) -> Tensor:
        vector.use(theta)
        return _advanced(model, windows.dt_model, steps, *parts)

    try:
        with few_operations():
            states = torch.func.vmap(one)(thetas, *map(torch.stack, zip(*begun, strict=True)))
    except RuntimeError:  # an effect of the user's own that branches on its values
        states = torch.stack([one(theta, *parts) for theta, parts in zip(thetas, begun, strict=True)])
    out = states.new_empty(len(starts), *states.shape[2:])
    for own, part in zip(rows, states, strict=True):
        out[own] = part[: len(own)]
    return out


def _begun(model: IdentifiedModel, windows: Windows, starts: Tensor) -> tuple[Tensor, ...]:
    """States with their memory, inputs and times of the starts of predictions."""
    x, u, t0 = windows.batch(starts)
    before, dt = inputs_before(model.system, windows, starts), windows.dt_model
    model.set_step(dt)
    return model.remembered(x[:, 0], u[:, 0], before, dt=dt), u, t0


def _advanced(
    model: IdentifiedModel, dt: float, steps: Sequence[int], z: Tensor, u: Tensor, t0: Tensor
) -> Tensor:
    system, solver, out = model.system, model.step, {}
    for k in range(max(steps)):
        z = system.project(solver.advance(model, t0[:, None] + k * dt, z, u[:, k], dt, None))
        if k + 1 in steps:
            out[k + 1] = z[:, : system.nx]
    return torch.stack([out[k] for k in steps], 1)
