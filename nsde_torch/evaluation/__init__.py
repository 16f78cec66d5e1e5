"""Evaluation: scores of models on runs that they have not seen, with intervals, and comparisons of models."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.evaluation.comparison import Comparison, compare
    from nsde_torch.evaluation.metrics import evaluate

__all__ = ["Comparison", "compare", "evaluate"]

__getattr__ = resolver(__name__)
