"""Learning: losses, optimisation, calibration, held-out scores and the run directory."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.learning.comparison import Comparison, compare
    from nsde_torch.learning.metrics import evaluate
    from nsde_torch.learning.options import LossOptions, TrainerOptions
    from nsde_torch.learning.structure import filter_reach, model_spec
    from nsde_torch.learning.training import Training, train

__all__ = [
    "Comparison",
    "LossOptions",
    "TrainerOptions",
    "Training",
    "compare",
    "evaluate",
    "filter_reach",
    "model_spec",
    "train",
]

__getattr__ = resolver(
    __name__,
    {
        "Comparison": "comparison",
        "LossOptions": "options",
        "TrainerOptions": "options",
        "Training": "training",
        "compare": "comparison",
        "evaluate": "metrics",
        "filter_reach": "structure",
        "model_spec": "structure",
        "train": "training",
    },
)
