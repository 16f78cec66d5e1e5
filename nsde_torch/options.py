"""Options: dataclass fields that carry their default, help, unit and range.

An option is declared once, in the dataclass of the library that it belongs to:

    @documented
    @dataclass(frozen=True)
    class Options(Checked):
        steps: int = key(1000, "largest number of gradient steps", unit="steps", low=1)

`documented` lists the options in the docstring, `Checked` refuses values out of range, and the command line makes its
keys of the same fields: names and types (OmegaConf), ranges, `--help`, the nearest key when one is mistyped.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar, get_type_hints

from nsde_torch.errors import ConfigError

T = TypeVar("T", bound=type)
REQUIRED: Any = dataclasses.MISSING
"""Default of an option that must be given."""
MISSING = "???"
"""What OmegaConf and `walk` have in its place."""


def key(
    default: Any,
    help: str,
    *,
    unit: str = "",
    choices: tuple[str, ...] | None = None,
    low: float | None = None,
    above: float | None = None,
    high: float | None = None,
    file: bool = False,
) -> Any:
    """A dataclass field that documents itself.

    Args:
        default: Default, `REQUIRED` for none; a list or dict is copied for every instance.
        help: One sentence for `--help`, without a full stop.
        unit: Unit of the value, empty if it has none.
        choices: The words that are allowed.
        low: Smallest value allowed (of every entry, if the value is a list).
        above: Bound that the value must exceed.
        high: Largest value allowed.
        file: Whether the value names a file or folder (or several, or may do so).
    """
    limits = {"choices": choices, "low": low, "above": above, "high": high}
    return declared(default, {"help": help, "unit": unit, **limits, "file": file})


def declared(default: Any, metadata: Mapping[str, Any]) -> Any:
    """A dataclass field of `key` from its default and its metadata."""
    if isinstance(default, (list, dict)):
        return dataclasses.field(default_factory=lambda: copy.deepcopy(default), metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Key:
    """One key as `--help` shows it."""

    path: str
    annotation: str
    default: Any
    help: str
    unit: str
    choices: tuple[str, ...] | None
    low: float | None
    above: float | None
    high: float | None
    file: bool

    @property
    def allowed(self) -> str:
        """The range in words, empty if anything of the right type is allowed."""
        if self.choices is not None:
            return " | ".join(self.choices)
        if self.low is not None and self.high is not None:
            return f"from {self.low:g} to {self.high:g}"
        bounds = {"at least": self.low, "above": self.above, "at most": self.high}
        return ", ".join(f"{words} {bound:g}" for words, bound in bounds.items() if bound is not None)


def default_of(field: dataclasses.Field[Any]) -> Any:
    """Default of an option, `MISSING` where it has none."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return MISSING if field.default is dataclasses.MISSING else field.default


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
        yield Key(path=path, annotation=str(field.type), default=default_of(field), **field.metadata)


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
        if value is None or (value == math.inf and entry.default == math.inf):
            continue  # infinity says that there is no limit
        for item in value if isinstance(value, (list, tuple)) else [value]:
            if isinstance(item, int) and abs(item) >= 1 << 63:
                raise ConfigError(f"`{prefix}{entry.path}` must have fewer than 19 digits; got {item!r}.")
            if not _allowed(entry, item):
                raise ConfigError(f"`{prefix}{entry.path}` must be {entry.allowed}; got {item!r}.")


class Checked:
    """Base of options that are checked when they are made (`check`)."""

    def __post_init__(self) -> None:
        check(type(self), vars(self))


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


def documented(cls: T) -> T:
    """List the options of a dataclass in its docstring: help, unit, range and default of each.

    What the command line calls null is None in Python.
    """
    lines = []
    for entry in walk(cls):
        notes = [entry.help.replace("null", "None")]
        notes += [f"[{entry.unit}]"] if entry.unit else []
        notes += [f"({entry.allowed})"] if entry.allowed else []
        default = "" if entry.default == MISSING else f" Default: {entry.default!r}."
        lines.append(f"        {entry.path}: {' '.join(notes)}.{default}")
    cls.__doc__ = f"{(cls.__doc__ or '').rstrip()}\n\n    Args:\n" + "\n".join(lines) + "\n    "
    return cls
