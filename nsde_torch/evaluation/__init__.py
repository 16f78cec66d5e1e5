"""Evaluation: scores of models on runs that they have not seen, with intervals, and comparisons of models."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import names, resolver

if TYPE_CHECKING:
    from nsde_torch.evaluation.comparison import Comparison, compare
    from nsde_torch.evaluation.metrics import evaluate

__all__ = names(__name__)
__getattr__ = resolver(__name__)
