"""`system.effects=PATH`: the effects of a file in the place of its name (`nsde_torch.effects.files`)."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig, open_dict

from nsde_torch.effects.files import is_file, own_name, read_for
from nsde_torch.effects.law import split_name


def expand(system: DictConfig) -> None:
    """Put the effects of files in the place of their names, and their values under `system.parameters`."""
    names: list[str] = []
    for entry in system.effects:
        if not is_file(entry):
            names.append(entry)
            continue
        effects = read_for(entry, system.name)
        names += effects
        for effect, values in effects.items():
            for key, value in values.items():
                add_value(system, own_name(effect), key, value)
    system.effects = names


def add_value(system: DictConfig, effect: str, name: str, value: Any) -> None:
    """Set `system.parameters.EFFECT.NAME` unless it was given."""
    with open_dict(system.parameters):
        given = system.parameters
        law, coordinate = split_name(effect)
        if f"{effect}.{name}" in given or (coordinate and name in _placed(given, law, coordinate)):
            return
        if effect not in given:
            given[effect] = {}
        if name not in given[effect]:
            given[effect][name] = value


def _placed(given: DictConfig, law: str, coordinate: str) -> Any:
    """What `system.parameters.LAW[COORDINATE]` was given on the command line, where it is a level of its own."""
    return (given.get(law) or {}).get(coordinate) or {}


def add_own(system: DictConfig, name: str, value: Any) -> None:
    """Set `system.parameters.NAME` of the system itself unless it was given."""
    with open_dict(system.parameters):
        if name not in system.parameters:
            system.parameters[name] = value
