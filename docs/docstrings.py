"""Docstrings as griffe expects them.

Its Google style knows the section "Examples", and ours say "Example". Options say their help, unit and range in
`key(...)` (`nsde_torch.options`), and fields of small classes in the comment behind them, which are here the docstrings
of the attributes.
"""

from __future__ import annotations

import ast
import re
from typing import Any

import griffe


class Examples(griffe.Extension):
    """Renames the section wherever it stands."""

    def on_instance(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """See `griffe.Extension`."""
        if obj.docstring is not None:
            obj.docstring.value = re.sub(r"^Example:$", "Examples:", obj.docstring.value, flags=re.MULTILINE)


class Options(griffe.Extension):
    """Gives an attribute that is declared by `key(default, help, unit=...)` its help for a docstring."""

    def on_attribute_instance(self, *, attr: griffe.Attribute, **kwargs: Any) -> None:
        """See `griffe.Extension`."""
        call = attr.value
        if not isinstance(call, griffe.ExprCall) or str(call.function) != "key" or attr.docstring is not None:
            return
        default, *rest = call.arguments
        named = {a.name: a.value for a in rest if isinstance(a, griffe.ExprKeyword)}
        (help,) = [a for a in rest if not isinstance(a, griffe.ExprKeyword)]
        try:
            text = str(ast.literal_eval(str(help)))
            unit = str(ast.literal_eval(str(named["unit"]))) if "unit" in named else ""
        except ValueError:  # a help that several options share
            return
        text = text.replace("null", "None")
        attr.docstring = griffe.Docstring(f"{text[0].upper()}{text[1:]}{f' [{unit}]' if unit else ''}.")
        attr.value = default if isinstance(default, str) else str(default)


class Comments(griffe.Extension):
    """Gives a field of a class the comment behind it for a docstring."""

    def on_attribute_instance(self, *, attr: griffe.Attribute, **kwargs: Any) -> None:
        """See `griffe.Extension`."""
        comment = re.search(r"  # (.+)$", attr.lines[-1]) if attr.lines else None
        if (
            attr.docstring is None
            and comment is not None
            and attr.parent is not None
            and attr.parent.is_class
        ):
            text = comment[1]
            attr.docstring = griffe.Docstring(f"{text[0].upper()}{text[1:]}.")
