"""Where an optimisation stands."""

import math
from dataclasses import dataclass, field


@dataclass
class Progress:
    """Where an optimisation stands."""

    step: int = 0  # gradient steps done
    best_step: int = 0  # step of the kept weights
    best_score: float = math.inf  # validation score of the kept weights
    history: list[dict[str, float]] = field(default_factory=list)  # one row per validation
    stopped: bool = False  # whether early stopping ended it
    polished: int = 0  # steps done on all windows after that
