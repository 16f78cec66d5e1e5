"""Values of parameters as a user writes them: `name` of the system, `effect.name` of an effect, or nested mappings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

Numbers = dict[str, float | list[float]]


def dotted(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """`{effect: {name: 1}}` as `effect.name`, and `{law: {coordinate: {name: 1}}}` as `law[coordinate].name`."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from dotted(value, f"{prefix}{name}.")
            continue
        path = f"{prefix}{name}"
        parts = path.split(".")
        if len(parts) == 3 and "[" not in parts[0]:
            path = f"{parts[0]}[{parts[1]}].{parts[2]}"
        yield path, value


def split_values(values: Mapping[str, Any]) -> tuple[Numbers, dict[str, Numbers]]:
    """Values of the system's own parameters, and those of its effects."""
    own: Numbers = {}
    of_effects: dict[str, Numbers] = {}
    for path, value in dotted(values):
        effect, dot, name = path.partition(".")
        if dot:
            of_effects.setdefault(effect, {})[name] = value
        else:
            own[path] = value
    return own, of_effects
