"""Keys of the groups `system`, `model`, `loss`, `trainer` and `solver`."""

from __future__ import annotations

from dataclasses import dataclass

from nsde_torch.models.options import (
    BlackboxOptions,
    EnsembleOptions,
    NodeOptions,
    NsdeOptions,
    SysidOptions,
)
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


@mirrors(NodeOptions)
class NodeModel(ModelConfig):
    """Neural ODE."""


@mirrors(NsdeOptions)
class NsdeModel(ModelConfig):
    """Neural SDE."""


@mirrors(BlackboxOptions)
class BlackboxModel(ModelConfig):
    """Neural SDE without physics."""


@mirrors(EnsembleOptions)
class EnsembleModel(ModelConfig):
    """Gaussian ensemble."""


@mirrors(SysidOptions)
class SysidModel(ModelConfig):
    """Least-squares system identification."""


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
