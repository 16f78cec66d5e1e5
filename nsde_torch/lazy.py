"""Names of a package that are resolved on first use, so that `import nsde_torch` and `nsde --help` stay quick.

A package says what is public in `__all__`, and where each name lives in the imports that type checkers see:

    if TYPE_CHECKING:
        from nsde_torch.data.windows import Windows

    __all__ = names(__name__)
    __getattr__ = resolver(__name__)

A name must not be that of a module of the package: which of the two it is would depend on what was imported before.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from importlib.abc import InspectLoader
from typing import Any


def resolver(package: str, home: Mapping[str, str] | None = None) -> Callable[[str], Any]:
    """The `__getattr__` of a package: a function of a name, which raises AttributeError for one that is not public.

    Args:
        package: Its `__name__`.
        home: Public name -> module of the package that defines it; without it, the imports for type checkers say so.
    """

    def resolve(name: str) -> Any:
        homes = _homes(package) if home is None else {n: f"{package}.{module}" for n, module in home.items()}
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(homes[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    return resolve


def names(package: str) -> list[str]:
    """The `__all__` of a package of this `__name__`: what it imports for type checkers alone."""
    return sorted(_homes(package))


@cache
def _homes(package: str) -> dict[str, str]:
    """Name -> module of the names that a package imports for type checkers alone, read once from its source."""
    spec = sys.modules[package].__spec__
    source = spec.loader.get_source(package) if spec and isinstance(spec.loader, InspectLoader) else None
    return {
        name.name: f"{statement.module}"
        for condition in ast.parse(source or "").body
        if isinstance(condition, ast.If)
        for statement in condition.body
        if isinstance(statement, ast.ImportFrom)
        for name in statement.names
    }


class LazyModule:
    """A module that is imported where its first name is asked for.

    Args:
        name: Its full name.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self._name), name)
