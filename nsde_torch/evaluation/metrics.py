"""Held-out errors, interval coverage and scores of a model on runs that it has not seen.

Starts lie on a regular grid of every run; a start whose longest horizon would cross a gap is left out, so that
every horizon is scored from the same starts. What is scored is in `nsde_torch.evaluation.scores`.
"""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from nsde_torch.data import Run, Windows
from nsde_torch.data.interventions import interventional, longest_stretch
from nsde_torch.errors import DataError
from nsde_torch.evaluation.one_step import one_step
from nsde_torch.evaluation.scores import LEVELS, PARTICLES, Scores, baseline_squares, rms_by_group, score
from nsde_torch.models.model import Model

_HORIZONS = (0.1, 0.25, 0.5, 1.0, 2.0)
_START_EVERY = 0.25
_COARSEST = 0.5  # step up to which these are not longer
MOST_STARTS = 2000


def decade(pace: float, dt: float) -> float:
    """Power of ten that horizons are multiplied by of machines of a pace (`nsde_torch.data.pace`) and a step dt [s].

    The model of a reactor that is logged every 5 s was refused: no run was long enough for 0.1 s.
    """
    return float(10.0 ** max(int(math.log10(pace)), math.ceil(math.log10(dt / _COARSEST) - 1e-9)))


def all_horizons(pace: float, dt: float) -> list[float]:
    """0.1, 0.25, 0.5, 1 and 2 s, and for slower machines ten times as long and so on."""
    return [float(f"{h * decade(pace, dt):.3g}") for h in _HORIZONS]


def horizons_of(runs: Sequence[Run], dt: float) -> tuple[float, ...]:
    """Those of `all_horizons` that are not below a step and fit in the longest stretch."""
    # a regular grid of starts needs room to lie in; an intervention is where it is
    room = longest_stretch(runs) - (-1e-6 if interventional(runs) else dt)
    return tuple(h for h in all_horizons(runs[0].pace, dt) if h <= room and h >= 0.99 * dt)


def start_every(pace: float, dt: float) -> float:
    """Distance of starts [s]: 0.25 s, of slower machines ten times that and so on, as a whole number of data steps."""
    return max(1, round(_START_EVERY * decade(pace, dt) / dt)) * dt


def start_grid(windows: Windows) -> Tensor:
    """Window numbers of the starts, at distances of `start_every`; or the interventions."""
    return windows.starts(start_every(windows.pace, windows.dt))


def thinned(starts: Tensor, most: int = MOST_STARTS) -> Tensor:
    """At most 2000 of the starts, or so many rows of any table, evenly spread."""
    if len(starts) <= most:
        return starts
    return starts[torch.linspace(0, len(starts) - 1, most).round().long()]


def windows_of(model: Model, runs: Sequence[Run], steps: int) -> Windows:
    """Windows of so many steps of a model, of its type and where it is."""
    like = model.clock_scale
    return Windows(runs, model.spec.dt, steps, dtype=like.dtype, device=like.device)


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
        measurement_std: Sensor noise of these runs if it is not that of the training data (nx,).

    Returns:
        JSON-able: `horizons_s`, `starts`, `units`, and by group and then by horizon `errors` (of the model and of
        each baseline, root mean square of the norm), `coverage` (by level), `coverage_channels` (90 %), `crps`,
        `spread` and `nll` (each per channel, averaged; NLL of the channels in the units of the state, None without a
        spread); `diverged` counts starts without a finite prediction; `one_step` is what the model leaves of single
        steps (see `evaluation.one_step`), `inputs` whether those of predictions were replayed from the log or are
        interventional.

    Raises:
        DataError: no run is long enough.
    """
    dt = model.spec.dt
    horizons = horizons_of(runs, dt)
    if not horizons:
        least = all_horizons(runs[0].pace, dt)[0]
        raise DataError(f"no run is long enough for a horizon of {least:g} s; evaluate on longer runs.")
    steps = [max(1, round(h / dt)) for h in horizons]
    windows = windows_of(model, runs, steps[-1])
    starts = thinned(start_grid(windows))
    if len(starts) == 0:
        raise DataError(f"no stretch of {horizons[-1]} s without a gap; evaluate on longer runs.")
    scores = score(
        model,
        windows,
        starts,
        steps,
        seed=seed,
        particles=particles,
        compile=compile,
        measurement_std=measurement_std,
    )
    keys = [f"{h:g}" for h in horizons]
    found = summary(scores, keys)
    if found["errors"]:
        still = baseline_squares(model.system, windows, starts[scores.kept], steps)
        baselines = {name: rms_by_group(model.system, squares, keys) for name, squares in still.items()}
        found["errors"] = {"model": found["errors"], **baselines}
    return {
        "horizons_s": list(horizons),
        "starts": len(starts),
        "particles": particles,
        "diverged": scores.diverged,
        "units": {g.name: g.unit for g in model.system.error_groups},
        "inputs": "interventional" if interventional(runs) else "replayed",
        "one_step": one_step(model, runs),
        **found,
    }


def summary(scores: Scores, horizons: Sequence[str]) -> dict[str, Any]:
    """Means over the starts, by the name of the horizon; empty without a finite start."""
    names = ("errors", "coverage", "coverage_channels", "crps", "spread", "nll")
    result: dict[str, Any] = {name: {} for name in names}
    result["coverage"] = {f"{level:g}": {} for level in LEVELS}
    if len(scores.kept) == 0:
        return result
    system, dtype = scores.system, scores.crps.dtype
    result["errors"] = rms_by_group(system, scores.squares, horizons)
    inside = scores.inside.to(dtype).mean(0)
    crps, spread = scores.crps.mean(0), scores.spread.square().mean(0).sqrt()
    nll = scores.nll.mean(0)
    for k, h in enumerate(horizons):
        for i, name in enumerate(system.error_names):
            result["coverage_channels"].setdefault(name, {})[h] = float(inside[k, LEVELS.index(0.9), i])
        for g in system.error_groups:
            at = list(g.channels)
            for j, level in enumerate(LEVELS):
                result["coverage"][f"{level:g}"].setdefault(g.name, {})[h] = float(inside[k, j, at].mean())
            result["crps"].setdefault(g.name, {})[h] = float(crps[k, at].mean()) * g.factor
            result["spread"].setdefault(g.name, {})[h] = float(spread[k, at].mean()) * g.factor
            value = float(nll[k, at].mean())
            result["nll"].setdefault(g.name, {})[h] = value if math.isfinite(value) else None
    return result
