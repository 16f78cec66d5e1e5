"""`effects.yaml`: effects with their values, as a diagnosis found them; `system.effects=PATH` takes them all.

    system: cartpole
    effects:
      cart_coulomb_friction: {size: 0.31, width: 0.02}

Values are where a training starts from. They do not bind it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, open_dict

from nsde_torch.errors import ConfigError

SUFFIXES = (".yaml", ".yml")


def is_file(entry: str) -> bool:
    """Whether an entry of `system.effects` names a file."""
    return entry.endswith(SUFFIXES)


def read(path: str | Path) -> tuple[str, dict[str, dict[str, Any]]]:
    """System and effects of a file.

    Raises:
        ConfigError: no such file, or not what it should be.
    """
    file = Path(path)
    if not file.is_file():
        raise ConfigError(f"`system.effects`: no file {str(path)!r}. `nsde diagnose` writes effects.yaml.")
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"`system.effects`: {file} is not YAML: {error}") from error
    effects = content.get("effects") if isinstance(content, Mapping) else None
    if not isinstance(effects, Mapping) or not all(isinstance(v, Mapping | None) for v in effects.values()):
        raise ConfigError(
            f"`system.effects`: {file} must hold `effects:` with `NAME: {{parameter: value}}` under it."
        )
    return str(content.get("system", "")), {str(k): dict(v or {}) for k, v in effects.items()}


def write(path: Path, system: str, effects: Mapping[str, Mapping[str, Any]], note: str) -> None:
    """Write a file that `system.effects=PATH` takes."""
    text = yaml.safe_dump(
        {"system": system, "effects": {k: dict(v) for k, v in effects.items()}}, sort_keys=False
    )
    path.write_text(f"# {note}\n{text}", encoding="utf-8")


def expand(system: DictConfig) -> None:
    """Put the effects of files in the place of their names, and their values under `system.parameters`.

    Raises:
        ConfigError: a file that cannot be used, or one of another system.
    """
    names: list[str] = []
    for entry in system.effects:
        if not is_file(entry):
            names.append(entry)
            continue
        of, effects = read(entry)
        if of and of != system.name:
            raise ConfigError(
                f"`system.effects`: {entry} was found on system {of!r}, and this is {system.name!r}."
            )
        names += effects
        for effect, values in effects.items():
            for key, value in values.items():
                add_value(system, _own_name(effect), key, value)
    system.effects = names


def _own_name(effect: str) -> str:
    """What an effect's parameters are listed under."""
    from nsde_torch.effects import effect_class

    return effect_class(effect).name if ":" in effect else effect


def add_value(system: DictConfig, effect: str, name: str, value: Any) -> None:
    """Set `system.parameters.EFFECT.NAME` unless it was given."""
    with open_dict(system.parameters):
        given = system.parameters
        if f"{effect}.{name}" in given:
            return
        if effect not in given:
            given[effect] = {}
        if name not in given[effect]:
            given[effect][name] = value


def add_own(system: DictConfig, name: str, value: Any) -> None:
    """Set `system.parameters.NAME` of the system itself unless it was given."""
    with open_dict(system.parameters):
        if name not in system.parameters:
            plain = value.tolist()
            system.parameters[name] = plain[0] if len(plain) == 1 else plain
