"""Training: from data to a run directory, by gradients, by prediction errors and by least squares."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import names, resolver

if TYPE_CHECKING:
    from nsde_torch.training.options import LossOptions, TrainerOptions
    from nsde_torch.training.session import Training

__all__ = names(__name__)

__getattr__ = resolver(__name__)
