"""Keys of a configuration: dataclass fields that carry their help, unit and range.

One declaration serves the check of names and types (OmegaConf), that of ranges (`check`), `--help` and the
suggestion of the nearest key when one is mistyped.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, get_type_hints

from nsde_torch.errors import ConfigError


def key(
    default: Any,
    help: str,
    *,
    unit: str = "",
    choices: tuple[str, ...] | None = None,
    low: float | None = None,
    above: float | None = None,
    high: float | None = None,
) -> Any:
    """A dataclass field that documents itself.

    Args:
        default: Default; a list or dict is copied for every instance.
        help: One sentence for `--help`, without a full stop.
        unit: Unit of the value, empty if it has none.
        choices: The words that are allowed.
        low: Smallest value allowed (of every entry, if the value is a list).
        above: Bound that the value must exceed.
        high: Largest value allowed.
    """
    metadata = {"help": help, "unit": unit, "choices": choices, "low": low, "above": above, "high": high}
    if isinstance(default, (list, dict)):
        return dataclasses.field(default_factory=lambda: copy.deepcopy(default), metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def group(default: type, help: str) -> Any:
    """A field that holds the choice of a config group."""
    return dataclasses.field(default_factory=default, metadata={"help": help, "group": True})


@dataclass(frozen=True)
class Key:
    """One key as `--help` shows it; `owner` is the dataclass that declares it."""

    path: str
    annotation: str
    default: Any
    help: str
    unit: str
    choices: tuple[str, ...] | None
    low: float | None
    above: float | None
    high: float | None
    owner: type

    @property
    def allowed(self) -> str:
        """The range in words, empty if anything of the right type is allowed."""
        if self.choices is not None:
            return " | ".join(self.choices)
        if self.low is not None and self.high is not None:
            return f"from {self.low:g} to {self.high:g}"
        if self.above is not None and self.high is not None:
            return f"above {self.above:g}, at most {self.high:g}"
        if self.low is not None:
            return f"at least {self.low:g}"
        if self.above is not None:
            return f"above {self.above:g}"
        return f"at most {self.high:g}" if self.high is not None else ""


def walk(schema: type, prefix: str = "") -> Iterator[Key]:
    """Every key of a schema with its dotted path, those of its groups included, in order."""
    hints = get_type_hints(schema)
    for field in dataclasses.fields(schema):
        path = f"{prefix}{field.name}"
        if dataclasses.is_dataclass(hints[field.name]):
            yield from walk(hints[field.name], f"{path}.")
            continue
        if "help" not in field.metadata:
            raise AssertionError(f"{schema.__name__}.{field.name} has no help: declare it with `key(...)`")
        default = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
        yield Key(path=path, annotation=str(field.type), default=default, owner=schema, **field.metadata)


def check(schema: type, values: Mapping[str, Any], prefix: str = "") -> None:
    """Check every value against the choices and the range that its key declares.

    Args:
        schema: Dataclass of the keys.
        values: The configuration as plain containers.
        prefix: Path of `values` within the whole configuration, with a final dot.

    Raises:
        ConfigError: A value is outside what its key allows; the message names key, range and value.
    """
    for entry in walk(schema):
        if "." in entry.path:
            continue
        value = values.get(entry.path)
        if value is None:
            continue
        for item in value if isinstance(value, (list, tuple)) else [value]:
            if not _allowed(entry, item):
                raise ConfigError(f"`{prefix}{entry.path}` must be {entry.allowed}; got {item!r}.")


def _allowed(entry: Key, value: Any) -> bool:
    if entry.choices is not None:
        return str(value) in entry.choices
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return True
    return (
        math.isfinite(value)
        and (entry.low is None or value >= entry.low)
        and (entry.above is None or value > entry.above)
        and (entry.high is None or value <= entry.high)
    )
