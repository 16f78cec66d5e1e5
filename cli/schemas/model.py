"""Keys of the groups `system`, `model`, `loss`, `trainer` and `solver`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from nsde_torch.models.options import MODELS, ModelOptions
from nsde_torch.sde.options import IntegratorOptions, TorchDiffEqOptions
from nsde_torch.systems.options import SystemOptions
from nsde_torch.training.options import LossOptions, TrainerOptions

from ..keys import key, mirrors, of


@mirrors(SystemOptions)
class SystemConfig:
    """The machine. A value of null is the system's own: its class has the constants of the supplement."""


@dataclass
class ModelConfig:
    """What is learned."""

    kind: str = key("???", "kind of the model, set by model=")


@dataclass
class OwnModel(ModelConfig):
    """A kind of model of the user's own."""

    kind: str = key("???", "kind of the model: module:Class of your own")
    options: dict[str, Any] = key({}, "its options, model.options.NAME=1")


def _keys_of(options: type[ModelOptions]) -> type:
    """Keys for every option of a kind of model."""
    space = {"__doc__": options.__doc__, "__module__": __name__}
    return mirrors(options)(type(options.__name__.replace("Options", "Model"), (ModelConfig,), space))


MODEL_CHOICES: dict[str, type] = {**{name: _keys_of(cls) for name, cls in MODELS.items()}, "own": OwnModel}
"""Choices of the group `model`: every kind of the package, and one of the user's own."""
# a configuration that a sweep sends to another process finds its class by name
globals().update({cls.__name__: cls for cls in MODEL_CHOICES.values()})


@mirrors(LossOptions, without=("ball_radius",))
class LossConfig:
    """Weights and sizes of the losses; the radius of the ball is a constant of the machine."""

    kind: str = of(LossOptions, "kind", default="???")


@mirrors(TrainerOptions)
class TrainerConfig:
    """Optimisation."""


@mirrors(IntegratorOptions)
class SolverConfig:
    """The integrator."""


@mirrors(TorchDiffEqOptions)
class TorchDiffEqSolver(SolverConfig):
    """A method of torchdiffeq."""
