"""YAML files that people write: read without objects, and refused in one sentence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from nsde_torch.errors import ConfigError

_LARGEST = 1 << 20  # bytes


def read_yaml(file: str | Path) -> Any:
    """What a YAML file holds, as plain containers.

    Args:
        file: The file.

    Raises:
        ConfigError: no regular file of 1 MiB or less, or no plain YAML in UTF-8; the message names the line.
    """
    file = Path(file)
    try:
        if not file.is_file() or file.stat().st_size > _LARGEST:
            raise ConfigError(f"{file}: no regular file of 1 MiB or less; expected a YAML file.")
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
        if _size(content, {}) > _LARGEST:
            raise ConfigError(f"{file}: its aliases represent more than a million values.")
        return content
    except ConfigError:
        raise
    except UnicodeDecodeError:
        raise ConfigError(f"{file} is no UTF-8 text; expected a YAML file.") from None
    except RecursionError:
        raise ConfigError(f"{file}: no plain YAML (it refers to itself, or is nested too deeply).") from None
    except (yaml.YAMLError, OSError, ValueError) as error:
        mark, why = getattr(error, "problem_mark", None), getattr(error, "problem", None) or str(error)
        line = "" if mark is None else f", line {mark.line + 1}"
        raise ConfigError(f"{file}{line}: no plain YAML ({' '.join(why.split())[:160]}).") from None


def _size(value: Any, known: dict[int, int]) -> int:
    """Values in containers with every alias written out, which is what whoever goes through them meets."""
    if id(value) not in known:
        inside = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
        known[id(value)] = 1 + sum(_size(one, known) for one in inside)
    return known[id(value)]
