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
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any


def resolver(package: str) -> Callable[[str], Any]:
    """The `__getattr__` of a package of this `__name__`: AttributeError for a name that is not public."""

    def resolve(name: str) -> Any:
        homes = _homes(package)
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
    source = Path(f"{sys.modules[package].__file__}").read_text(encoding="utf-8")
    return {
        name.name: f"{statement.module}"
        for condition in ast.parse(source).body
        if isinstance(condition, ast.If)
        for statement in condition.body
        if isinstance(statement, ast.ImportFrom)
        for name in statement.names
    }


class LazyModule:
    """A module of this full name that is imported where its first name is asked for."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self._name), name)
