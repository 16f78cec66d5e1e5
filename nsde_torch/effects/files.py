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


def read_for(path: str | Path, system: str) -> dict[str, dict[str, Any]]:
    """Effects of a file for a system, by name.

    Raises:
        ConfigError: a file that cannot be used, or one of another system.
    """
    of, effects = read(path)
    if of and of != system:
        raise ConfigError(f"`system.effects`: {path} was found on system {of!r}, and this is {system!r}.")
    return effects


def own_name(effect: str) -> str:
    """What an effect's parameters are listed under: the effect's own name, of `module:Class` and of a law too."""
    from nsde_torch.effects.registry import effect_class

    return str(effect_class(effect).name) if ":" in effect or is_law(effect) else effect
