"""Models that predict trajectories with intervals."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.models.ensemble import EnsembleSpec, GaussianEnsemble
    from nsde_torch.models.identified import IdentifiedModel, SysidSpec
    from nsde_torch.models.model import Model, ModelSpec
    from nsde_torch.models.neural_sde import NeuralSDE, SDESpec
    from nsde_torch.models.options import (
        MODELS,
        BlackboxOptions,
        EnsembleOptions,
        ModelOptions,
        NodeOptions,
        NsdeOptions,
        SysidOptions,
    )
    from nsde_torch.models.registry import SPECS, make_model, make_spec
    from nsde_torch.models.run_directory import load, save

__all__ = [
    "MODELS",
    "SPECS",
    "BlackboxOptions",
    "EnsembleOptions",
    "EnsembleSpec",
    "GaussianEnsemble",
    "IdentifiedModel",
    "Model",
    "ModelOptions",
    "ModelSpec",
    "NeuralSDE",
    "NodeOptions",
    "NsdeOptions",
    "SDESpec",
    "SysidOptions",
    "SysidSpec",
    "load",
    "make_model",
    "make_spec",
    "save",
]

__getattr__ = resolver(
    __name__,
    {
        "MODELS": "options",
        "SPECS": "registry",
        "BlackboxOptions": "options",
        "EnsembleOptions": "options",
        "EnsembleSpec": "ensemble",
        "GaussianEnsemble": "ensemble",
        "IdentifiedModel": "identified",
        "Model": "model",
        "ModelOptions": "options",
        "ModelSpec": "model",
        "NeuralSDE": "neural_sde",
        "NodeOptions": "options",
        "NsdeOptions": "options",
        "SDESpec": "neural_sde",
        "SysidOptions": "options",
        "SysidSpec": "identified",
        "load": "run_directory",
        "make_model": "registry",
        "make_spec": "registry",
        "save": "run_directory",
    },
)
