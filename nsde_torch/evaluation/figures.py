"""The pictures of a training: learning curves, held-out rollouts, calibration, errors, distance, data."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nsde_torch import plots
from nsde_torch.data import DataSet, Run, Windows
from nsde_torch.models.before import sampled
from nsde_torch.models.capabilities import is_stochastic
from nsde_torch.models.model import Model
from nsde_torch.models.neural_sde import NeuralSDE

_SHOWN = 3
_PARTICLES = 128


def write_figures(
    folder: Path,
    model: Model,
    data: DataSet,
    *,
    train: Sequence[Run],
    test: Sequence[Run],
    metrics: Mapping[str, Any],
    history: Sequence[Mapping[str, float]],
    seed: int,
    note: str,
) -> dict[str, Any]:
    """Draw all figures and save them as PNG.

    Args:
        folder: Where to write.
        model: The trained model.
        data: The data set.
        train: Training runs.
        test: Held-out runs.
        metrics: What `metrics.json` will hold.
        history: One row per validation.
        seed: Seed of the particles.
        note: What the inputs see of the future, for the titles; may be empty.

    Returns:
        The figures by name.
    """
    figures: dict[str, Any] = {"data_summary": plots.data_summary(data, model.system)}
    if history:
        figures["learning_curves"] = plots.learning_curves(_data_terms(history), kept=metrics["best_step"])
    if is_stochastic(model) and model.eta.standardise.mean.numel() >= 2:
        figures["distance"] = plots.distance_map(_slices(model, train, test))
    result = metrics.get("test")
    if result and result["errors"]:
        horizons = result["horizons_s"]
        keys = [f"{h:g}" for h in horizons]
        errors = {m: {g: [v[k] for k in keys] for g, v in by.items()} for m, by in result["errors"].items()}
        figures["held_out_errors"] = plots.horizon_errors(horizons, errors, result["units"])
        if any(value > 0 for by in result["spread"].values() for value in by.values()):
            levels = sorted(result["coverage"], key=float)
            groups = list(result["units"])
            pooled = {
                g: [float(np.mean(list(result["coverage"][q][g].values()))) for q in levels] for g in groups
            }
            at90 = {g: [result["coverage"]["0.9"][g][k] for k in keys] for g in groups}
            figures["calibration"] = plots.calibration_curve(
                [float(q) for q in levels], pooled, horizons=horizons, per_horizon=at90
            )
        figures["held_out_rollouts"] = _rollouts(model, test, horizons[-1], seed, note)
    for name, figure in figures.items():
        plots.save(figure, folder / f"{name}.png")
    return figures


def _data_terms(history: Sequence[Mapping[str, float]]) -> list[dict[str, float]]:
    """The history with the data term as the loss: what the validation score is to be held against."""
    return [{**row, "loss": row["data"]} if "data" in row else dict(row) for row in history]


@torch.no_grad()
def _rollouts(model: Model, runs: Sequence[Run], horizon_s: float, seed: int, note: str) -> Any:
    dt = model.spec.dt
    like = model.clock_scale
    windows = Windows(runs, dt, max(1, round(horizon_s / dt)), dtype=like.dtype, device=like.device)
    count = min(_SHOWN, len(windows))
    at = (
        torch.linspace(0, len(windows) - 1, count + 2)[1:-1].round().long()
        if count > 1
        else torch.tensor([0])
    )
    x, samples, t0 = sampled(
        model, windows, at, particles=_PARTICLES, generator=torch.Generator().manual_seed(seed)
    )
    system = model.system
    where = [f"{name}, t = {float(t):.1f} s" for name, t in zip(_names(windows, at), t0, strict=True)]
    title = "Held-out rollouts: measured against sampled"
    return plots.rollout_bands(
        np.arange(windows.horizon + 1) * dt,
        x.cpu().numpy(),
        samples.transpose(0, 1).cpu().numpy(),
        names=list(system.state_names),
        units=list(system.state_units),
        title=f"{title} ({note})" if note else title,
        quaternion=system.quaternion,
        starts=where,
    )


def _names(windows: Windows, at: Tensor) -> list[str]:
    return [name for name, _ in windows.locate(at)]


def _rows(model: Model, runs: Sequence[Run], limit: int) -> Tensor:
    x = np.concatenate([run.x[a:b] for run in runs for a, b in run.segments])
    keep = np.linspace(0, len(x) - 1, min(limit, len(x))).round().astype(int)
    return torch.as_tensor(x[keep]).to(model.clock_scale)


@torch.no_grad()
def _slices(model: NeuralSDE, train: Sequence[Run], test: Sequence[Run]) -> list[plots.DistanceSlice]:
    system = model.system
    inside = system.features(_rows(model, train, 5000)).cpu().numpy()
    outside = system.features(_rows(model, test, 2000)).cpu().numpy() if test else inside[:0]
    n = inside.shape[1]
    pairs = [(0, 1)] if n < 4 else [(0, 1), (n - 2, n - 1)] if n < 6 else [(0, 1), (3, 4)]
    slices = []
    for pair in pairs:
        points, x, y = plots.slice_grid(inside, pair)
        eta = model.eta(torch.as_tensor(points).to(model.clock_scale)).cpu().numpy()
        labels = [f"{system.feature_names[k]} [{system.feature_units[k]}]" for k in pair]
        slices.append(
            plots.DistanceSlice(
                x,
                y,
                eta.reshape(len(y), len(x)),
                labels[0],
                labels[1],
                train=inside[:, list(pair)],
                held_out=outside[:, list(pair)],
            )
        )
    return slices
