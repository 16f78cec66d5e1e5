"""Training: from data to a run directory, by gradients, by prediction errors and by least squares."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.training.options import LossOptions, TrainerOptions
    from nsde_torch.training.session import Training, train
    from nsde_torch.training.structure import model_spec

__all__ = ["LossOptions", "TrainerOptions", "Training", "model_spec", "train"]

__getattr__ = resolver(__name__)
