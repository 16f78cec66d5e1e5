"""Names of a package that are resolved on first use, so that `import nsde_torch` and `nsde --help` stay quick.

A package says what is public in `__all__`, and where each name lives:

    __all__ = ["Windows", "read"]
    __getattr__ = resolver(__name__, {"Windows": "windows", "read": "registry"})

A name must not be that of a module of the package: which of the two it is would depend on what was imported before.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def resolver(package: str, home: Mapping[str, str]) -> Callable[[str], Any]:
    """The `__getattr__` of a package.

    Args:
        package: Its `__name__`.
        home: Public name -> module of the package that defines it, dotted if it lies deeper.

    Returns:
        A function of a name; it raises AttributeError for a name that is not public.
    """

    def resolve(name: str) -> Any:
        if name not in home:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(f"{package}.{home[name]}"), name)
        setattr(sys.modules[package], name, value)
        return value

    return resolve


class LazyModule:
    """A module that is imported where its first name is asked for.

    Args:
        name: Its full name.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self._name), name)
