"""Learning: losses, optimisation, calibration, held-out scores and the run directory."""

from nsde_torch.learning.metrics import evaluate
from nsde_torch.learning.options import LossOptions, TrainerOptions
from nsde_torch.learning.training import Training, filter_reach, train

__all__ = ["LossOptions", "TrainerOptions", "Training", "evaluate", "filter_reach", "train"]
