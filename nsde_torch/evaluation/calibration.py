"""Calibration of the diffusion by errors on runs that a model did not see.

A model is surer of the runs that it was fitted to than of a new one: errors grow from fitted to new runs, the
learned spread does not. The widening is estimated from the training runs alone:

1. kappa_fit is the factor on sigma, nearest to 1, at which the final model's 90 % intervals hold 90 to 92 % of the
   N runs it was fitted to, pooled over groups and horizons;
2. each training run in turn is left out, an auxiliary model is fitted to the N - 1 others, and kappa_new is the
   factor at which its intervals hold as much of the run left out;
3. the excess of a model fitted to n runs on a new one falls as 1 / n and is not negative, so for N runs

    log kappa = log kappa_fit + max(mean log kappa_new - log kappa_fit, 0) (N - 1) / N

One factor for all channels: several, sought on so few runs, fitted the runs and missed the next. The test run is
never looked at.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from nsde_torch.data import Run, Windows
from nsde_torch.errors import DataError, NonFiniteError
from nsde_torch.evaluation.metrics import horizons_of, interval_quantiles, start_grid
from nsde_torch.models.before import inputs_before
from nsde_torch.models.neural_sde import NeuralSDE

_LEVEL = 0.9
_MOST = 0.92
_PARTICLES = 39
_STARTS = 256
_BRACKET = (math.log(0.25), math.log(6.0))
_HALVINGS = 9


class Coverage:
    """Coverage of a model's 90 % intervals on runs, as a function of a factor on sigma.

    Args:
        model: The model; left as it was.
        runs: Runs to cover.
        seed: Seed of the particles, the same for every factor.
        compile: Compile the integrator's step.
    """

    def __init__(self, model: NeuralSDE, runs: Sequence[Run], *, seed: int, compile: bool) -> None:
        self.model, self.seed, self.compile = model, seed, compile
        dt = model.spec.dt
        self.steps = [max(1, round(h / dt)) for h in horizons_of(runs, dt)]
        if not self.steps:
            raise DataError("no run is long enough for a horizon of 0.1 s.")
        like = model.clock_scale
        windows = Windows(runs, dt, self.steps[-1], dtype=like.dtype, device=like.device)
        starts = start_grid(windows)
        if len(starts) == 0:
            raise DataError(f"no start of the grid has {self.steps[-1] * dt:g} s without a gap after it.")
        if len(starts) > _STARTS:
            starts = starts[torch.linspace(0, len(starts) - 1, _STARTS).round().long()]
        self.x, self.u, t0 = windows.batch(starts)
        self.t0 = t0.to(like.dtype)
        self.u_before = inputs_before(model.system, windows, starts)

    @torch.no_grad()
    def __call__(self, log_factor: float) -> float:
        """Share of measurements inside, averaged over channels of each group, groups and horizons.

        A factor under which paths leave the finite numbers counts as one that holds everything: it is too large.
        """
        model, base = self.model, self.model.h.log_sigma_max.clone()
        model.h.log_sigma_max.copy_(base + log_factor)
        try:
            samples = model.sample(
                self.x[:, 0],
                self.u,
                dt=model.spec.dt,
                particles=_PARTICLES,
                generator=torch.Generator().manual_seed(self.seed),
                compile=self.compile,
                t0=self.t0,
                u_before=self.u_before,
            )
        except NonFiniteError:
            return 1.0
        finally:
            model.h.log_sigma_max.copy_(base)
        errors = model.system.error(samples[:, :, self.steps], self.x[:, self.steps])
        low, high = interval_quantiles(errors, _LEVEL)
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
        near, far = 0.0, _BRACKET[1] if now < _LEVEL else _BRACKET[0]
        if now > _MOST and self(far) > _MOST:
            return 0.0
        for _ in range(_HALVINGS):
            middle = (near + far) / 2
            held = self(middle)
            if (held >= _LEVEL) if now < _LEVEL else (held <= _MOST):
                far = middle
            else:
                near = middle
        return far


def extrapolate(fitted: float, new: Sequence[float], n_runs: int) -> float:
    """log kappa for a run that is new to a model of `n_runs` runs; see the module docstring.

    Args:
        fitted: log kappa_fit.
        new: log kappa_new of each run left out; empty where there is one run alone.
        n_runs: Training runs N.
    """
    if not new:
        return fitted
    excess = sum(new) / len(new) - fitted
    return fitted + max(excess, 0.0) * (n_runs - 1) / n_runs


@torch.no_grad()
def widen(model: NeuralSDE, log_factor: float) -> None:
    """Multiply sigma by a factor."""
    model.h.log_sigma_max.add_(Tensor([log_factor]).to(model.h.log_sigma_max))
