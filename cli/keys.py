"""Keys of a configuration, made of the options of the library (`nsde_torch.options`).

A key mirrors an option (`of`), or is the command line's own (`key`); `mirrors` makes a key of every option of a
dataclass of the library. OmegaConf wants lists where the library has tuples, and classes that are not frozen.
"""

import dataclasses
import functools
import inspect
import operator
import types
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from nsde_torch.options import Key, check, declared, default_of, key, walk

__all__ = ["Key", "check", "group", "key", "mirrors", "of", "walk"]

T = TypeVar("T")


def group(default: type, help: str) -> Any:
    """A field that holds the choice of a config group."""
    return dataclasses.field(default_factory=default, metadata={"help": help, "group": True})


def of(library: type, name: str, **changed: Any) -> Any:
    """A key that mirrors an option of the library; `changed` is what is another here: `default`, `help`, `unit`, ..."""
    field = {f.name: f for f in dataclasses.fields(library)}[name]
    default = changed.pop("default", default_of(field))
    return declared(_listed_value(default), {**field.metadata, **changed})


def mirrors(library: type, *, without: tuple[str, ...] = ()) -> Callable[[type[T]], type[T]]:
    """Class decorator: a key for every option of the library's, before the class's own, which may replace some."""

    def make(cls: type[T]) -> type[T]:
        own = dict(inspect.get_annotations(cls))
        hints = get_type_hints(library)
        annotations: dict[str, Any] = {}
        for field in dataclasses.fields(library):
            if field.name in without:
                continue
            if field.name in own:
                annotations[field.name] = own.pop(field.name)
            else:
                annotations[field.name] = _listed(hints[field.name])
                setattr(cls, field.name, of(library, field.name))
        cls.__annotations__ = {**annotations, **own}
        return dataclasses.dataclass(cls)

    return make


def _listed_value(value: Any) -> Any:
    return [_listed_value(item) for item in value] if isinstance(value, tuple) else value


def _listed(hint: Any) -> Any:
    """A type with lists and dicts in the place of tuples, sequences and mappings."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return functools.reduce(operator.or_, map(_listed, inner))
    if origin in (tuple, Sequence):
        return list[_listed(inner[0])]  # type: ignore[misc]
    if origin is Mapping:
        return dict[str, Any]
    return hint
