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

from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.errors import ConfigError
from nsde_torch.plain_yaml import read_yaml
from nsde_torch.whole_files import write_whole

SUFFIXES = (".yaml", ".yml")


def is_file(entry: str) -> bool:
    """Whether an entry of `system.effects` names a file."""
    return entry.endswith(SUFFIXES)


def read(path: str | Path, key: str = "system.effects") -> tuple[str, dict[str, dict[str, Any]]]:
    """System and effects of a file; a ConfigError names the key by which it was given, where it is none."""
    file = Path(path)
    if not file.is_file():
        raise ConfigError(f"`{key}`: no file {str(path)!r}. `nsde diagnose` writes effects.yaml.")
    try:
        content = read_yaml(file)
    except ConfigError as error:
        raise ConfigError(f"`{key}`: {error}") from None
    effects = content.get("effects") if isinstance(content, Mapping) else None
    if not isinstance(effects, Mapping) or not all(isinstance(v, Mapping | None) for v in effects.values()):
        raise ConfigError(f"`{key}`: {file} must hold `effects:` with `NAME: {{parameter: value}}` under it.")
    return str(content.get("system", "")), {str(k): dict(v or {}) for k, v in effects.items()}


def write(path: Path, system: str, effects: Mapping[str, Mapping[str, Any]], note: str) -> None:
    """Write a file that `system.effects=PATH` takes."""
    text = yaml.safe_dump(
        {"system": system, "effects": {k: dict(v) for k, v in effects.items()}}, sort_keys=False
    )
    write_whole(path, f"# {note}\n{text}")


def read_for(path: str | Path, system: str | None, key: str = "system.effects") -> dict[str, dict[str, Any]]:
    """Effects of a file for a system (None: any), by name; messages name the file by a key.

    Raises:
        ConfigError: a file that cannot be used, or one of another system.
    """
    of, effects = read(path, key)
    if of and system is not None and of != system:
        raise ConfigError(f"`{key}`: {path} was found on system {of!r}, and this is {system!r}.")
    return effects


def own_name(effect: str) -> str:
    """What an effect's parameters are listed under: the effect's own name, of `module:Class` and of a law too."""
    from nsde_torch.effects.registry import effect_class

    return str(effect_class(effect).name) if ":" in effect or is_law(effect) else effect
