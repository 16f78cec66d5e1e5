"""A kind of model: the next state is linear in state and input, with Gaussian noise.

    x_{k+1} = A x_k + B u_k + c + s e_k,        e_k ~ Normal(0, 1)

A, B and c by ridge regression on pairs of consecutive states, s by what is left over.
"""

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any

import torch
from torch import Tensor

from nsde_torch.data import Windows
from nsde_torch.errors import ConfigError
from nsde_torch.models import Model, ModelOptions, ModelSpec
from nsde_torch.models.kind import Choice, ModelKind
from nsde_torch.options import key
from nsde_torch.training.task import Fitted, Progress, Task


@dataclass(frozen=True)
class LinearOptions(ModelOptions):
    """What a user chooses."""

    ridge: float = key(1e-6, "weight on the squares of A, B and c", low=0)


@dataclass(frozen=True)
class LinearSpec(ModelSpec):
    """What is saved beside the weights."""

    _: KW_ONLY
    ridge: float = 1e-6


class LinearModel(Model):
    """The model: a table of weights and a standard deviation for each state."""

    def __init__(
        self, spec: LinearSpec, *, generator: torch.Generator, values: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__()
        self.spec, self.system, self.filter = spec, spec.make_system(values), None
        n = self.system.nx + self.system.nu + len(self.system.exogenous) + 1
        self.register_buffer("clock_scale", torch.ones(()))
        self.register_buffer("weights", torch.zeros(n, self.system.nx))
        self.register_buffer("std", torch.zeros(self.system.nx))

    def sample(
        self,
        x0: Tensor,
        u: Tensor,
        *,
        dt: float,
        particles: int,
        generator: torch.Generator,
        measurement: bool = True,
        measurement_std: Tensor | None = None,
        applied: bool = False,
        compile: bool = False,
        t0: float | Tensor = 0.0,
        u_before: Tensor | None = None,
    ) -> Tensor:
        """See `Model.sample`; states are predicted as they are measured."""
        if abs(dt / self.spec.dt - 1) > 1e-6:
            raise ConfigError(
                f"this model learned steps of {self.spec.dt:g} s and knows no other; got {dt:g} s."
            )
        x, u = self.checked(x0, u, particles, generator)
        path = [x.expand(particles, *x.shape)]
        for k in range(u.shape[1]):
            row = rows(path[-1], u[:, k].expand(particles, *u[:, k].shape))
            noise = torch.randn(path[-1].shape, generator=generator, dtype=x.dtype)
            after = row @ self.weights + self.std * noise
            path.append(self.project(after.flatten(0, 1)).view(after.shape))
        return torch.stack(path, 2)


class Linear(ModelKind):
    """The kind: its options, what is saved, the model, and how it is fitted."""

    options = LinearOptions
    spec = LinearSpec
    model = LinearModel

    @classmethod
    def make_spec(cls, choice: Choice) -> LinearSpec:
        """What the user chose, and what every model has."""
        assert isinstance(choice.options, LinearOptions)
        return LinearSpec(**choice.common, ridge=choice.options.ridge)

    @classmethod
    def fit(cls, task: Task) -> Fitted:
        """Ridge regression on all pairs of consecutive states."""
        assert isinstance(task.spec, LinearSpec)
        model = LinearModel(task.spec, generator=torch.Generator().manual_seed(task.seed), values=task.values)
        model = model.to(device=task.device, dtype=task.dtype)
        pairs = Windows(task.runs, task.spec.dt, 1, dtype=task.dtype, device=task.device)
        x, u, _ = pairs.batch(torch.arange(len(pairs)))
        seen, after = rows(x[:, 0], u[:, 0]).double(), x[:, 1].double()
        square = seen.T @ seen + task.spec.ridge * torch.eye(seen.shape[1], dtype=torch.float64)
        weights = torch.linalg.solve(square, seen.T @ after)
        left = after - seen @ weights
        model.weights.copy_(weights)
        model.std.copy_(left.std(0))
        model.clock_scale.fill_(task.clock)
        score = float((left.std(0) / after.std(0)).mean())
        return Fitted(model, Progress(step=1, best_step=1, best_score=score), facts={"loss": "least squares"})


def rows(x: Tensor, u: Tensor) -> Tensor:
    """State (..., nx) and input (..., nu) with a one behind them: (..., nx + nu + 1)."""
    return torch.cat((x, u, torch.ones_like(x[..., :1])), -1)
