"""Where an optimisation stands."""

import math
from dataclasses import dataclass, field


@dataclass
class Progress:
    """Where an optimisation stands.

    Args:
        step: Gradient steps done.
        best_step: Step of the kept weights.
        best_score: Validation score of the kept weights.
        polished: Steps done on all windows after that.
        history: One row per validation.
        stopped: Whether early stopping ended it.
    """

    step: int = 0
    best_step: int = 0
    best_score: float = math.inf
    history: list[dict[str, float]] = field(default_factory=list)
    stopped: bool = False
    polished: int = 0
