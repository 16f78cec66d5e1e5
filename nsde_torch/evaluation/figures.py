"""Figures of an evaluation."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.optimize import brentq
from torch import Tensor

from nsde_torch import plots
from nsde_torch.arrays import Array
from nsde_torch.data import DataSet, Run
from nsde_torch.errors import DataError, NonFiniteError
from nsde_torch.evaluation.metrics import horizons_of, start_grid, thinned, windows_of
from nsde_torch.evaluation.scores import interval_quantiles
from nsde_torch.models.model import Model, is_stochastic, sampled
from nsde_torch.models.neural_sde import NeuralSDE
from nsde_torch.plots.style import some

# Calibration of the diffusion by errors on runs that a model did not see.
#
# A model is surer of the runs that it was fitted to than of a new one: errors grow from fitted to new runs,
# the learned spread does not. The widening is estimated from the training runs alone:
#
# 1. kappa_fit is the factor on sigma, nearest to 1, at which the final model's 90 % intervals hold 90 to 92 % of the
#    N runs it was fitted to, pooled over groups and horizons;
# 2. each training run in turn is left out, an auxiliary model is fitted to the N - 1 others, and kappa_new is the
#    factor at which its intervals hold as much of the run left out;
# 3. the excess of a model fitted to n runs on a new one falls as 1 / n and is not negative, so for N runs
#
#     log kappa = log kappa_fit + max(mean log kappa_new - log kappa_fit, 0) (N - 1) / N
#
# One factor for all channels: several, sought on so few runs, fitted the runs and missed the next. The test
# run is never looked at.
#
# Where something differs between runs, paths draw it. A run left out then says whether its own numbers are likely ones,
# and hardly anything of sigma: kappa is kappa_fit, of paths with the numbers of their run.

_LEVEL = 0.9
_MOST = 0.92
_RANKED_PARTICLES = 39
_STARTS = 256
_BRACKET = (math.log(0.25), math.log(6.0))
_FIRST_STEP = 0.1
_RESOLUTION = 0.005


class Coverage:
    """Coverage of a model's 90 % intervals on runs, as a function of a factor on sigma; the model is left as it was.

    Particles are the same for every factor. `numbers` are what differs in each run, by its name, in standard deviations
    (`NeuralSDE.sample`); None draws it.
    """

    def __init__(
        self,
        model: NeuralSDE,
        runs: Sequence[Run],
        *,
        seed: int,
        compile: bool,
        numbers: Mapping[str, Sequence[float]] | None = None,
    ) -> None:
        self.model, self.seed, self.compile = model, seed, compile
        dt = model.spec.dt
        self.steps = [max(1, round(h / dt)) for h in horizons_of(runs, dt)]
        if not self.steps:
            raise DataError("no run is long enough for the shortest horizon.")
        self.windows = windows_of(model, runs, self.steps[-1])
        self.starts = thinned(start_grid(self.windows), _STARTS)
        if len(self.starts) == 0:
            raise DataError(f"no start of the grid has {self.steps[-1] * dt:g} s without a gap after it.")
        own = [numbers[name] for name, _ in self.windows.locate(self.starts)] if numbers else None
        self.numbers = None if own is None else model.clock_scale.new_tensor(own)

    @torch.no_grad()
    def __call__(self, log_factor: float) -> float:
        """Share of measurements inside, averaged over channels of each group, groups and horizons.

        A factor under which paths leave the finite numbers counts as one that holds everything: it is too large.
        """
        model, base = self.model, self.model.h.log_sigma_max.clone()
        model.h.log_sigma_max.copy_(base + log_factor)
        try:
            x, samples, _ = sampled(
                model,
                self.windows,
                self.starts,
                particles=_RANKED_PARTICLES,
                generator=torch.Generator().manual_seed(self.seed),
                compile=self.compile,
                numbers=self.numbers,
                replayed=False,
            )
        except NonFiniteError:
            return 1.0
        finally:
            model.h.log_sigma_max.copy_(base)
        errors = model.system.error(samples[:, :, self.steps], x[:, self.steps])
        low, high = interval_quantiles(errors.sort(0).values, _LEVEL)
        inside = ((low <= 0) & (high >= 0)).to(errors.dtype).mean((0, 1))
        groups = [inside[list(g.channels)].mean() for g in model.system.error_groups]
        return float(torch.stack(groups).mean())

    def log_factor(self) -> float:
        """log of the factor nearest to 1 at which the coverage lies in [0.90, 0.92], within [1/4, 6].

        Where sensor noise rules, the coverage hardly depends on sigma. Intervals that hold too much by any factor
        down to 1/4 are no evidence that sigma is too large: the factor is then 1. Intervals that hold too little by
        any factor up to 6 get 6.
        """
        now = self(0.0)
        if _LEVEL <= now <= _MOST:
            return 0.0
        level, end = (_LEVEL, _BRACKET[1]) if now < _LEVEL else (_MOST, _BRACKET[0])
        held, near, far = {0.0: now}, 0.0, math.copysign(_FIRST_STEP, end)
        while True:  # from 1 on: most factors are near it, and each call is a rollout of all starts
            held[far] = self(far)
            if (held[far] - level) * (now - level) <= 0:
                break
            if far == end:
                return end if now < _LEVEL else 0.0
            near, far = far, math.copysign(min(2 * abs(far), abs(end)), end)

        def excess(log_factor: float) -> float:
            return (held[log_factor] if log_factor in held else self(log_factor)) - level

        return float(brentq(excess, near, far, xtol=_RESOLUTION))


def falls_short(log_factor: float) -> bool:
    """Whether intervals hold too little by any factor that is tried."""
    return log_factor >= _BRACKET[1]


def extrapolate(fitted: float, new: Sequence[float], n_runs: int) -> float:
    """log kappa for a run that is new to a model of `n_runs` runs, see above; `new` is empty where there is one."""
    if not new:
        return fitted
    excess = sum(new) / len(new) - fitted
    return fitted + max(excess, 0.0) * (n_runs - 1) / n_runs


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
    """Draw all figures of a training, save them as PNG, and return them by name.

    `metrics` are what `metrics.json` will hold; `note` is what the inputs see of the future, for the titles.
    """
    figures: dict[str, Any] = {"data_summary": plots.data_summary(data, model.system)}
    if history:
        # the data term as the loss: what the validation score is to be held against
        shown = [{**row, "loss": row["data"]} if "data" in row else row for row in history]
        figures["learning_curves"] = plots.learning_curves(shown, kept=metrics["best_step"])
    if is_stochastic(model) and model.eta.standardise.mean.numel() >= 2:
        figures["distance"] = plots.distance_map(_slices(model, train, test))
    result = metrics.get("test")
    if result and result["errors"]:
        horizons = result["horizons_s"]
        keys = [f"{h:g}" for h in horizons]
        errors = {m: {g: [v[k] for k in keys] for g, v in by.items()} for m, by in result["errors"].items()}
        figures["held_out_errors"] = plots.horizon_errors(horizons, errors, result["units"])
        if any(value > 0 for by in result["spread"].values() for value in by.values()):
            inside, groups = result["coverage"], list(result["units"])
            levels = sorted(inside, key=float)
            pooled = {g: [float(np.mean(list(inside[q][g].values()))) for q in levels] for g in groups}
            at90 = {g: [inside["0.9"][g][k] for k in keys] for g in groups}
            nominal = [float(q) for q in levels]
            later = {"horizons": horizons, "per_horizon": at90}
            figures["calibration"] = plots.calibration_curve(nominal, pooled, **later)
        figures["held_out_rollouts"] = _rollouts(model, test, horizons[-1], seed, note)
    for name, figure in figures.items():
        plots.save(figure, folder / f"{name}.png")
    return figures


@torch.no_grad()
def _rollouts(model: Model, runs: Sequence[Run], horizon_s: float, seed: int, note: str) -> Any:
    dt = model.spec.dt
    windows = windows_of(model, runs, max(1, round(horizon_s / dt)))
    count = min(_SHOWN, len(windows))
    inner = torch.linspace(0, len(windows) - 1, count + 2)[1:-1].round().long()
    at = inner if count > 1 else torch.tensor([0])
    generator, system = torch.Generator().manual_seed(seed), model.system
    x, samples, t0 = sampled(model, windows, at, particles=_PARTICLES, generator=generator)
    title = "Held-out rollouts: measured against sampled"
    times: Array = dt * np.arange(windows.horizon + 1, dtype=np.float64)
    columns = {
        f"{name}, t = {float(t):.1f} s": (times, x[k].cpu().numpy(), samples[:, k].cpu().numpy())
        for k, ((name, _), t) in enumerate(zip(windows.locate(at), t0, strict=True))
    }
    return plots.rollout_bands(
        columns,
        names=list(system.state_names),
        units=list(system.state_units),
        title=f"{title} ({note})" if note else title,
        quaternion=system.quaternion,
    )


def _rows(model: Model, runs: Sequence[Run], most: int) -> Tensor:
    x = np.concatenate([run.x[a:b] for run in runs for a, b in run.segments])
    return torch.as_tensor(some(x, most)).to(model.clock_scale)


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
        across, up = (f"{system.feature_names[k]} [{system.feature_units[k]}]" for k in pair)
        data = (table[:, list(pair)] for table in (inside, outside))
        slices.append(plots.DistanceSlice(x, y, eta.reshape(len(y), len(x)), across, up, *data))
    return slices
