"""Models that predict trajectories with intervals."""

from nsde_torch.models.ensemble import EnsembleSpec, GaussianEnsemble
from nsde_torch.models.identified import IdentifiedModel, SysidSpec
from nsde_torch.models.model import Model, ModelSpec
from nsde_torch.models.neural_sde import NeuralSDE, SDESpec
from nsde_torch.models.registry import SPECS, make_model, make_spec

__all__ = [
    "SPECS",
    "EnsembleSpec",
    "GaussianEnsemble",
    "IdentifiedModel",
    "Model",
    "ModelSpec",
    "NeuralSDE",
    "SDESpec",
    "SysidSpec",
    "make_model",
    "make_spec",
]
