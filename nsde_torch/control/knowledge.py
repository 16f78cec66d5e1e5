"""What a controller knows of a machine: a trained model, or its declared physics with the values of the plant."""

from __future__ import annotations

from nsde_torch.models import Model
from nsde_torch.models.run_directory import load
from nsde_torch.systems import System, make_plant_system
from nsde_torch.systems.machines import Effects

DECLARED = "declared"
"""Stands for the declared physics in the place of a run directory."""


def knowledge(run: str, system: str, *, effects: Effects = ()) -> Model | System:
    """A model, or the declared physics.

    Args:
        run: Run directory of a model, or `declared`.
        system: Name of the machine, for the declared physics.
        effects: Effects beside the declared ones, with their values (see `make_plant_system`).

    Raises:
        CheckpointError: no such run directory, or a damaged one.
        ConfigError: no plant of that name, or an effect that it cannot have.
    """
    if run == DECLARED:
        return make_plant_system(system, effects=effects, declared_only=True)
    return load(run)


def system_of(known: Model | System) -> System:
    """The machine that is known."""
    return known if isinstance(known, System) else known.system
