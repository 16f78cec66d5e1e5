"""Models that predict trajectories with intervals."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import names, resolver

if TYPE_CHECKING:
    from nsde_torch.models.ensemble import EnsembleSpec, GaussianEnsemble
    from nsde_torch.models.identified import IdentifiedModel, SysidSpec
    from nsde_torch.models.kind import Choice, ModelKind, model_kind, model_options
    from nsde_torch.models.model import Capabilities, Model, ModelSpec
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
    from nsde_torch.models.run_directory import load, make_model, make_spec, save

__all__ = names(__name__)

__getattr__ = resolver(__name__)
