"""Choices that need no file of values: with keys of their own, or with a name alone; made of the library's tables."""

from __future__ import annotations

from nsde_torch.sde.names import STEP_HOMES
from nsde_torch.systems.names import SYSTEM_HOMES

from .data import DATA_CHOICES
from .model import MODEL_CHOICES, TorchDiffEqSolver
from .reference import REFERENCE_CHOICES

CHOICES: dict[str, dict[str, type]] = {
    "data": DATA_CHOICES,
    "model": MODEL_CHOICES,
    "solver": {"torchdiffeq": TorchDiffEqSolver},
    "reference": REFERENCE_CHOICES,
}

NAMES: dict[str, tuple[str, ...]] = {
    "system": tuple(SYSTEM_HOMES),
    "solver": tuple(name for name in STEP_HOMES if name not in CHOICES["solver"]),
}
"""Choices that set nothing but the key `name`, each to its own."""
