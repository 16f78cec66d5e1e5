"""The pictures of an evaluation: errors against horizon, calibration, and rollouts of every model from one start."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nsde_torch import plots
from nsde_torch.errors import NonFiniteError
from nsde_torch.evaluation.common_grid import Candidate, Grid
from nsde_torch.evaluation.comparison import Comparison
from nsde_torch.evaluation.comparison_text import label
from nsde_torch.models.model import sampled

_PARTICLES = 199
_COLUMNS = 4  # models side by side


def write_figures(folder: Path, comparison: Comparison) -> list[Path]:
    """Draw and save errors, calibration (where a model has intervals) and rollouts, four models a figure; the files.

    What is shown of a model on runs that it was trained on is marked in red.
    """
    content = comparison.content
    finite = [m for m in content["models"] if m["errors"]]
    if not finite:
        return []
    made: dict[str, Any] = {"errors": _errors(content, finite)}
    spread = [m for m in finite if m["stochastic"]]
    if spread:
        made["calibration"] = _calibration(content, spread, [label(m) for m in finite])
    for number, figure in enumerate(_rollouts(comparison), 1):
        made["rollouts" if number == 1 else f"rollouts_{number}"] = figure
    return [plots.save(figure, folder / f"{name}.png") for name, figure in made.items()]


def _marked(figure: Any, models: Sequence[Mapping[str, Any]]) -> Any:
    """The figure with a warning if any of the models was trained on any of the runs."""
    seen = [m for m in models if not m["held_out"]]
    if seen:
        names = ", ".join(m["name"] for m in seen)
        plots.warn(figure, f"No test: {names} trained on runs that are shown here", [label(m) for m in seen])
    return figure


def _errors(content: Mapping[str, Any], models: Sequence[Mapping[str, Any]]) -> Any:
    keys = [f"{h:g}" for h in content["horizons_s"]]
    named = {label(m): m["errors"] for m in models} | dict(content["baselines"])
    errors = {name: {g: [row[h] for h in keys] for g, row in by.items()} for name, by in named.items()}
    count = f"{content['starts']} starts on {_runs(content)}"
    title = f"Error against horizon (RMSE of the mean prediction; {count})"
    figure = plots.horizon_errors(content["horizons_s"], errors, content["units"]["errors"], title=title)
    return _marked(figure, models)


def _runs(content: Mapping[str, Any]) -> str:
    names = [run["name"] for run in content["data"]["runs"]]
    return ", ".join(names) if len(names) <= 3 else f"{len(names)} runs"


def _calibration(
    content: Mapping[str, Any], models: Sequence[Mapping[str, Any]], order: Sequence[str]
) -> Any:
    keys = [f"{h:g}" for h in content["horizons_s"]]
    inside = {label(m): m["coverage"]["0.9"].items() for m in models}
    figure = plots.calibration_of_models(
        models[0]["calibration"]["nominal"],
        {label(m): m["calibration"]["share"] for m in models},
        horizons=content["horizons_s"],
        per_horizon={name: {g: [row[h] for h in keys] for g, row in by} for name, by in inside.items()},
        order=order,
        title=f"Share of measurements inside predicted intervals ({content['starts']} starts on {_runs(content)})",
    )
    return _marked(figure, models)


def _typical_start(comparison: Comparison) -> int:
    """Position of the start, held out if there is one, at which the first model's error is nearest to its median.

    The error is that of the longest horizon, summed over groups in shares of each group's mean square.
    """
    content = comparison.content
    number = next(k for k, m in enumerate(content["models"]) if m["errors"])
    scores = comparison.scores[number]
    squares = scores.squares[:, -1]
    size = (squares / squares.mean(0).clamp_min(1e-30)).sum(1).numpy()
    kept = scores.kept.numpy()
    seen = np.array([bool(run["trained_on_by"]) for run in content["data"]["runs"]])
    free = ~seen[comparison.grids[number].located()[0][kept]]
    rows = np.flatnonzero(free) if free.any() else np.arange(len(kept))
    return int(kept[rows[np.argsort(size[rows])[len(rows) // 2]]])


def _rollouts(comparison: Comparison) -> Iterator[Any]:
    content = comparison.content
    at = _typical_start(comparison)
    index, times = comparison.grids[0].located()
    run = content["data"]["runs"][int(index[at])]
    system = comparison.candidates[0].model.system
    drawn = []
    for m, candidate, grid in zip(content["models"], comparison.candidates, comparison.grids, strict=True):
        try:
            here = {"name": m["name"], "held_out": not m["trained_on"][run["name"]]}
            drawn.append((here, _paths(candidate, grid, at, content["seed"])))
        except NonFiniteError:
            continue  # counted as diverged, and said so
    for first in range(0, len(drawn), _COLUMNS):
        part = drawn[first : first + _COLUMNS]
        figure = plots.rollout_bands(
            {label(m): arrays for m, arrays in part},
            names=list(system.state_names),
            units=list(system.state_units),
            title=f"Rollouts from a typical start: {run['name']}, t = {times[at]:.2f} s",
            quaternion=system.quaternion,
            shared=True,
        )
        yield _marked(figure, [m for m, _ in part])


@torch.no_grad()
def _paths(candidate: Candidate, grid: Grid, at: int, seed: int) -> tuple[Any, Any, Any]:
    x, samples, _ = sampled(
        candidate.model,
        grid.windows,
        grid.starts[at : at + 1],
        particles=_PARTICLES,
        generator=torch.Generator().manual_seed(seed),
        dt=grid.dt,
        measurement_std=candidate.measurement_std,
    )
    t = np.arange(grid.windows.horizon + 1) * grid.windows.dt_model
    return t, x[0].cpu().numpy(), samples[:, 0].cpu().numpy()
