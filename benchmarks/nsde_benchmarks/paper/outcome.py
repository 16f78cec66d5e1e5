"""What an experiment concludes: pictures, what is claimed, what was measured, and whether it holds."""

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from nsde_torch.errors import NonFiniteError
from nsde_torch.evaluation.metrics import interval_quantiles, mean_state
from nsde_torch.models.model import Model
from nsde_torch.plots import PredictionBand


@dataclass(frozen=True)
class Check:
    """One claim held against a measurement.

    Args:
        claim: What should be.
        measured: What is, in words.
        passed: Whether the claim holds; None where it was not measured.
    """

    claim: str
    measured: str
    passed: bool | None

    @property
    def word(self) -> str:
        """pass, fail or not measured."""
        return "not measured" if self.passed is None else "pass" if self.passed else "fail"


@dataclass
class ExperimentOutcome:
    """What an experiment concludes.

    Args:
        title: Title of the picture.
        source: What the supplement says, in other words.
        checks: Claims and measurements.
        figures: matplotlib figures by name.
        values: Numbers behind the checks, JSON-able; units in the keys.
        notes: What a reader should know beside.
    """

    title: str
    source: str
    checks: list[Check] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)
    values: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Whether every claim that was measured holds."""
        return all(check.passed is not False for check in self.checks)


PARTICLES = 1999
"""The mean of so many is off by 2 % of their spread; that of 199 moved the error on the spring by a tenth of itself."""


@torch.no_grad()
def rollout(
    model: Model, x0: Tensor, u: Tensor, *, seed: int, measurement: bool, u_before: Tensor | None = None
) -> Tensor:
    """Paths of a model (P, B, T + 1, nx), not-a-number from where one has left the finite numbers.

    Args:
        model: The model.
        x0: First states (B, nx).
        u: Inputs (B, T, nu) on the model's step.
        seed: Seed of the particles.
        measurement: Whether measurements are predicted, or the state itself.
        u_before: Inputs of the steps before (B, K, nu); see `Model.sample`.
    """

    def sample(steps: int) -> Tensor:
        return model.sample(
            x0,
            u[:, :steps],
            dt=model.spec.dt,
            particles=PARTICLES,
            generator=torch.Generator().manual_seed(seed),
            measurement=measurement,
            u_before=u_before,
        )

    full = u.shape[1]
    try:
        return sample(full)
    except NonFiniteError:
        good, bad = 0, full  # the longest horizon that stays finite, by bisection
        while bad - good > 1:
            middle = (good + bad) // 2
            try:
                sample(middle)
                good = middle
            except NonFiniteError:
                bad = middle
        paths = x0.new_full((PARTICLES, len(x0), full + 1, x0.shape[1]), torch.nan)
        if good:
            paths[:, :, : good + 1] = sample(good)
        else:
            paths[:, :, 0] = x0
        return paths


def prediction(
    model: Model, paths: Tensor, name: str, *, level: float, interval: bool = True
) -> PredictionBand:
    """Mean and interval of the paths of one start (P, T + 1, nx)."""
    mean = mean_state(model.system, paths).double().numpy()
    if not interval:
        return PredictionBand(name, mean)
    low, high = interval_quantiles(paths.double(), level)
    return PredictionBand(name, mean, low.numpy(), high.numpy())
