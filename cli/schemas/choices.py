"""Choices whose keys are more than those of their group's class."""

from __future__ import annotations

from .data import CsvData, PublishedData, SimulatedData, UlogData
from .model import BlackboxModel, EnsembleModel, NodeModel, NsdeModel, SysidModel, TorchDiffEqSolver
from .reference import (
    CircleReference,
    CsvReference,
    HoverReference,
    LemniscateReference,
    WaypointReference,
)

CHOICES: dict[str, dict[str, type]] = {
    "data": {"simulated": SimulatedData, "csv": CsvData, "ulog": UlogData, "published": PublishedData},
    "model": {
        "nsde": NsdeModel,
        "node": NodeModel,
        "blackbox_nsde": BlackboxModel,
        "ensemble": EnsembleModel,
        "sysid": SysidModel,
    },
    "solver": {"torchdiffeq": TorchDiffEqSolver},
    "reference": {
        "circle": CircleReference,
        "lemniscate": LemniscateReference,
        "hover": HoverReference,
        "waypoints": WaypointReference,
        "csv": CsvReference,
    },
}
