"""Questions to a model about what it can do, typed so that the type checker knows what the answer means."""

from typing import TypeGuard

from nsde_torch.models.ensemble import GaussianEnsemble
from nsde_torch.models.identified import IdentifiedModel
from nsde_torch.models.model import Model
from nsde_torch.models.neural_sde import NeuralSDE


def has_physics(model: Model) -> TypeGuard[IdentifiedModel | NeuralSDE]:
    """Whether declared physics is the drift of the model, or part of it."""
    return model.capabilities.has_physics


def is_equation(model: Model) -> TypeGuard[NeuralSDE]:
    """Whether the model is a stochastic equation with a learned part."""
    return model.capabilities.is_equation


def is_stochastic(model: Model) -> TypeGuard[NeuralSDE]:
    """Whether the model is such an equation with a diffusion, and a distance from the data that scales it."""
    return model.capabilities.is_equation and model.capabilities.is_stochastic


def learns_sensors(model: Model) -> TypeGuard[NeuralSDE]:
    """Whether the model has a sensor noise of its own."""
    return model.capabilities.learns_sensors


def has_members(model: Model) -> TypeGuard[GaussianEnsemble]:
    """Whether the model is an ensemble, of whose members a particle follows one."""
    return model.capabilities.propagation is not None
