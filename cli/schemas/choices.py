"""Choices whose keys are more than those of their group's class."""

from __future__ import annotations

from .data import DATA_CHOICES
from .model import MODEL_CHOICES, TorchDiffEqSolver
from .reference import (
    CircleReference,
    CsvReference,
    HoverReference,
    LemniscateReference,
    WaypointReference,
)

CHOICES: dict[str, dict[str, type]] = {
    "data": DATA_CHOICES,
    "model": MODEL_CHOICES,
    "solver": {"torchdiffeq": TorchDiffEqSolver},
    "reference": {
        "circle": CircleReference,
        "lemniscate": LemniscateReference,
        "hover": HoverReference,
        "waypoints": WaypointReference,
        "csv": CsvReference,
    },
}
