"""What an experiment concludes: pictures, what is claimed, what was measured, and whether it holds."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from nsde_torch.errors import NonFiniteError
from nsde_torch.evaluation.scores import interval_quantiles, mean_state
from nsde_torch.models.model import Model
from nsde_torch.plots import PredictionBand


@dataclass(frozen=True)
class Check:
    """One claim held against a measurement."""

    claim: str  # what should be
    measured: str  # what is, in words
    passed: bool | None  # whether the claim holds; None where it was not measured

    @property
    def word(self) -> str:
        """pass, fail or not measured."""
        return "not measured" if self.passed is None else "pass" if self.passed else "fail"


def errs_less(
    horizon: str, other: str, pairs: Mapping[str, tuple[float, float]], units: Mapping[str, str]
) -> Check:
    """The claim that the SDE errs less at a horizon [s]: its error and that of the other by quantity."""
    told = (f"{g} {a:.3g} against {b:.3g} {units.get(g, '')}".rstrip() for g, (a, b) in pairs.items())
    claim = f"at {horizon} s the SDE errs less than {other} in every quantity"
    return Check(claim, "; ".join(told), all(a < b for a, b in pairs.values()))


@dataclass
class ExperimentOutcome:
    """What an experiment concludes."""

    title: str
    source: str  # what the supplement says, in other words
    checks: list[Check] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)  # matplotlib figures by name
    # numbers behind the checks, JSON-able; units in the keys
    values: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)  # what a reader should know beside


PARTICLES = 1999
"""The mean of so many is off by 2 % of their spread; that of 199 moved the error on the spring by a tenth of itself."""


@torch.no_grad()
def rollout(
    model: Model, x0: Tensor, u: Tensor, *, seed: int, measurement: bool, u_before: Tensor | None = None
) -> Tensor:
    """Paths of a model (P, B, T + 1, nx), not-a-number from where one has left the finite numbers."""

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

    try:
        return sample(u.shape[1])
    except NonFiniteError:
        good, bad = 0, u.shape[1]  # the longest horizon that stays finite, by bisection
    while bad - good > 1:
        middle = (good + bad) // 2
        try:
            sample(middle)
            good = middle
        except NonFiniteError:
            bad = middle
    paths = x0.new_full((PARTICLES, len(x0), u.shape[1] + 1, x0.shape[1]), torch.nan)
    paths[:, :, 0] = x0
    if good:
        paths[:, :, : good + 1] = sample(good)
    return paths


def prediction(model: Model, paths: Tensor, name: str, *, interval: bool = True) -> PredictionBand:
    """Mean and 95 % interval of the paths of one start (P, T + 1, nx)."""
    mean = mean_state(model.system, paths).double().numpy()
    if not interval:
        return PredictionBand(name, mean)
    low, high = interval_quantiles(paths.double(), 0.95)
    return PredictionBand(name, mean, low.numpy(), high.numpy())
