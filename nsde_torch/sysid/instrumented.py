"""What instruments say of the parameters; how they are asked is `instruments`."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

Array = NDArray[np.float64]

MISSING = 1e-3
"""Chance below which instruments show that an effect is missing."""
_SURE = 0.05  # chance below which two estimates differ


@dataclass(frozen=True)
class Instrumented:
    """What instruments say of the parameters."""

    names: tuple[str, ...]
    refused: dict[str, str]  # those that were not, name -> why
    labels: tuple[str, ...]
    values: Array  # estimates (k,): by instruments where they are strong, else ordinary ones
    covariance: Array  # of `values` (k, k)
    degrees: Array  # degrees of freedom (k,)
    strength: Array  # F of each parameter's first stage (k,); nan where the data do not show it
    moved: NDArray[np.bool_]  # whether the instruments show a parameter (k,)
    ordinary: Array  # ordinary estimates (k,)
    difference: Array
    """Chance of so large a difference from the ordinary estimate (k,), adjusted (Holm); 1 where not moved."""
    unexplained: float  # chance that declared physics explains all that the instruments do (Sargan)
    misfit: float = 0.0
    between_rows: bool = False
    """Whether inputs were taken to move between rows of the log, and not to be held."""
    leans: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Change of each estimate by instruments per error of each ordinary one beside it (k, k)."""

    @property
    def differs(self) -> bool:
        """Whether any estimate surely differs from the ordinary one."""
        return bool((self.difference < _SURE).any())

    def half_widths(self, level: float) -> Array:
        """Half-widths of intervals of this level (k,)."""
        wide = np.sqrt(np.diag(self.covariance).clip(0.0))
        return np.asarray(stdtrit(self.degrees.clip(1.0), 0.5 * (1 + level)) * wide)

    def as_dict(self) -> dict[str, Any]:
        """Plain containers, for JSON."""
        half = self.half_widths(0.9)
        return {
            "used": list(self.names),
            "refused": dict(self.refused),
            "inputs_move_between_rows": self.between_rows,
            "explains_all_that_they_do_chance": self.unexplained,
            "estimates": {
                label: {
                    "ordinary": float(self.ordinary[i]),
                    "by_instruments": float(self.values[i]),
                    "half_width_90": float(half[i]),
                    "first_stage_f": float(self.strength[i]),
                    "difference_chance": float(self.difference[i]),
                }
                for i, label in enumerate(self.labels)
                if self.moved[i]
            },
            "not_shown_by_the_instruments": [
                n for n, m in zip(self.labels, self.moved, strict=True) if not m
            ],
        }
