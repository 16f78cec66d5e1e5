"""The controller of the training runs, where it makes predictions under logged inputs better.

Its law is fitted by least squares (`models.feedback_model`). Whether it is kept is decided by what it is for: the fair
CRPS of predictions of the training runs with it, less that without it, as a share of the latter, must fall by more than
two standard errors. In open loop, and where setpoints rule all, it does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from nsde_torch.data import Run, Windows
from nsde_torch.evaluation.metrics import START_EVERY, horizons_of, start_grid
from nsde_torch.evaluation.scores import score
from nsde_torch.models.feedback_model import fit_feedback
from nsde_torch.models.neural_sde import NeuralSDE

_STARTS, _PARTICLES = 128, 49
_LONGEST_S = 1.0  # predictions from starts that are nearer to one another are not independent either
_SURE = 2.0  # standard errors; the built-in carts, in open loop, have -0.0003 +- 0.0054


@torch.no_grad()
def learn_feedback(model: NeuralSDE, runs: Sequence[Run], *, seed: int) -> dict[str, Any]:
    """Learn the controller of some runs, or take it out of the model.

    Returns:
        What `metrics.json` holds: `kept`, and, where the runs are long enough, `crps`: the change of the score as a
        share, and `standard_error`.
    """
    made, dt = fit_feedback(model, runs, model.spec.feedback), model.spec.dt
    steps = [round(h / dt) for h in horizons_of(runs, dt) if h <= _LONGEST_S and h > model.spec.feedback * dt]
    asked, like = model.spec, model.clock_scale
    model.feedback, model.spec = None, replace(asked, feedback=0)
    if made is None or not steps:
        return {"kept": False}
    windows = Windows(runs, dt, steps[-1], dtype=like.dtype, device=like.device)
    starts = start_grid(windows)
    if windows.interventional or len(starts) < 2:
        return {"kept": False}
    independent = len(starts) * START_EVERY / _LONGEST_S
    if len(starts) > _STARTS:
        starts = starts[torch.linspace(0, len(starts) - 1, _STARTS).round().long()]
    given: dict[str, Any] = {"seed": seed, "particles": _PARTICLES}
    without = score(model, windows, starts, steps, **given)
    model.feedback = made
    beside = score(model, windows, starts, steps, **given)
    mean = error = 0.0
    if not beside.diverged and not without.diverged:
        scale = without.crps.mean(0).clamp_min(1e-12)
        change = ((beside.crps - without.crps) / scale).mean((1, 2))  # of each start
        mean = float(change.mean())
        error = float(change.std()) / min(len(change), independent) ** 0.5
    kept = mean < -_SURE * error
    model.feedback, model.spec = (made, asked) if kept else (None, model.spec)
    return {"kept": kept, "crps": mean, "standard_error": error}
