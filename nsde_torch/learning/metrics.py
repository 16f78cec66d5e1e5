"""Held-out errors, interval coverage and scores of a model on runs that it has not seen.

Starts lie on a regular grid of every run; a start whose longest horizon would cross a gap is left out, so that
every horizon is scored from the same starts. The prediction is the mean of the particles (quaternions: of the
aligned and normalised ones). Intervals are quantiles at the plotting position p (P + 1): with 199 particles their ends
are order statistics, and a calibrated ensemble holds just these shares.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from nsde_torch.data import Run, Windows
from nsde_torch.errors import DataError, NonFiniteError
from nsde_torch.learning.losses import crps
from nsde_torch.models.model import Model
from nsde_torch.systems import System

HORIZONS = (0.1, 0.25, 0.5, 1.0, 2.0)
LEVELS = (0.1, 0.25, 0.5, 0.75, 0.9, 0.95)
START_EVERY = 0.25
PARTICLES = 199  # every level of LEVELS falls on an order statistic; their mean adds 0.25 % to the error
MOST_STARTS = 2000


def horizons_of(runs: Sequence[Run], dt: float) -> tuple[float, ...]:
    """Those of 0.1, 0.25, 0.5, 1 and 2 s that are not below a step and fit in the longest stretch."""
    longest = max(run.t[b - 1] - run.t[a] for run in runs for a, b in run.segments)
    return tuple(h for h in HORIZONS if h <= longest - dt and h >= 0.99 * dt)


def start_grid(windows: Windows) -> Tensor:
    """Window numbers of the starts: every 0.25 s, or the nearest whole number of data steps."""
    return windows.starts(max(1, round(START_EVERY / windows.dt)) * windows.dt)


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


def interval_quantiles(errors: Tensor, level: float) -> tuple[Tensor, Tensor]:
    """Lower and upper end of the central interval of an ensemble (P, ...)."""
    p = errors.shape[0]
    ordered = errors.sort(0).values

    def quantile(share: float) -> Tensor:
        at = min(max(share * (p + 1) - 1, 0.0), p - 1.0)
        low = int(at)
        high = min(low + 1, p - 1)
        return ordered[low] + (at - low) * (ordered[high] - ordered[low])

    return quantile((1 - level) / 2), quantile((1 + level) / 2)


def group_rms(system: System, errors: Tensor) -> dict[str, float]:
    """Root mean square of the norm of each error group, errors (B, n_error), in the group's unit."""
    return {
        g.name: float(errors[:, list(g.channels)].square().sum(1).mean().sqrt()) * g.factor
        for g in system.error_groups
    }


def baselines(system: System, x0: Tensor, elapsed: float) -> dict[str, Tensor]:
    """States (B, nx) after `elapsed` seconds if the state, or the velocity, stayed as it is."""
    moving = x0.clone()
    names = list(system.state_names)
    for position, velocity, _ in system.position_derivatives:
        moving[:, names.index(position)] += elapsed * x0[:, names.index(velocity)]
    return {"hold": x0, "constant_velocity": moving}


@torch.no_grad()
def evaluate(
    model: Model,
    runs: Sequence[Run],
    *,
    seed: int,
    particles: int = PARTICLES,
    compile: bool = False,
    measurement_std: Tensor | None = None,
) -> dict[str, Any]:
    """Score a model on runs.

    Args:
        model: The model.
        runs: Held-out runs.
        seed: Seed of the particles.
        particles: Paths per start.
        compile: Compile the integrator's step.
        measurement_std: Sensor noise of these runs if it is not that of the training data (nx,).

    Returns:
        JSON-able: `horizons_s`, `starts`, `units`, and by group and then by horizon `errors` (of the model and of
        each baseline, root mean square of the norm), `coverage` (by level), `coverage_channels` (90 %), `crps`
        and `spread` (both per channel, averaged); `diverged` counts starts without a finite prediction.

    Raises:
        DataError: no run is long enough.
    """
    system = model.system
    dt = model.spec.dt
    horizons = horizons_of(runs, dt)
    if not horizons:
        raise DataError("no run is long enough for a horizon of 0.1 s; evaluate on longer runs.")
    steps = [max(1, round(h / dt)) for h in horizons]
    device = model.clock_scale.device
    windows = Windows(runs, dt, steps[-1], dtype=model.clock_scale.dtype, device=device)
    starts = start_grid(windows)
    if len(starts) > MOST_STARTS:
        starts = starts[torch.linspace(0, len(starts) - 1, MOST_STARTS).round().long()]
    if len(starts) == 0:
        raise DataError(f"no stretch of {horizons[-1]} s without a gap; evaluate on longer runs.")
    generator = torch.Generator().manual_seed(seed)
    collected: dict[int, list[Tensor]] = {k: [] for k in steps}
    truth: dict[int, list[Tensor]] = {k: [] for k in steps}
    first: list[Tensor] = []
    diverged = 0
    parts = list(starts.split(256))
    while parts:
        part = parts.pop(0)
        x, u, t0 = windows.batch(part)
        try:
            samples = model.sample(
                x[:, 0],
                u,
                dt=dt,
                particles=particles,
                generator=generator,
                compile=compile,
                t0=t0.to(x.dtype),
                measurement_std=measurement_std,
            )
        except NonFiniteError:
            if len(part) > 1:  # look for those at fault; the others are scored
                parts[:0] = part.chunk(2)
            else:
                diverged += 1
            continue
        first.append(x[:, 0])
        for k in steps:
            collected[k].append(samples[:, :, k])
            truth[k].append(x[:, k])
    result: dict[str, Any] = {
        "horizons_s": list(horizons),
        "starts": len(starts),
        "particles": particles,
        "diverged": diverged,
        "units": {g.name: g.unit for g in system.error_groups},
        "errors": {},
        "coverage": {f"{level:g}": {} for level in LEVELS},
        "coverage_channels": {},
        "crps": {},
        "spread": {},
    }
    if not first:
        return result
    x0 = torch.cat(first)
    errors: dict[str, dict[str, dict[str, float]]] = {}
    for h, k in zip(horizons, steps, strict=True):
        at_h = f"{h:g}"
        sample, y = torch.cat(collected[k], 1), torch.cat(truth[k])
        predictions = {"model": mean_state(system, sample), **baselines(system, x0, k * dt)}
        for name, prediction in predictions.items():
            for group, value in group_rms(system, system.error(prediction, y)).items():
                errors.setdefault(name, {}).setdefault(group, {})[at_h] = value
        e = system.error(sample, y.expand_as(sample))
        score, spread = crps(e).mean(0), e.std(0, correction=min(1, particles - 1)).square().mean(0).sqrt()
        inside90 = None
        for level in LEVELS:
            low, high = interval_quantiles(e, level)
            inside = ((low <= 0) & (high >= 0)).to(e.dtype).mean(0)
            if level == 0.9:
                inside90 = inside
            for g in system.error_groups:
                row = result["coverage"][f"{level:g}"].setdefault(g.name, {})
                row[at_h] = float(inside[list(g.channels)].mean())
        assert inside90 is not None
        for i, name in enumerate(system.error_names):
            result["coverage_channels"].setdefault(name, {})[at_h] = float(inside90[i])
        for g in system.error_groups:
            at = list(g.channels)
            result["crps"].setdefault(g.name, {})[at_h] = float(score[at].mean()) * g.factor
            result["spread"].setdefault(g.name, {})[at_h] = float(spread[at].mean()) * g.factor
    result["errors"] = errors
    return result
