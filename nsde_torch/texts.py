"""Texts for people: templates in the folder `templates` beside the module that asks for them, filled in."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment


def rendered(module: str, template: str, **values: Any) -> str:
    """A template beside a module (its `__file__`); `{{ x|fmt(".3g") }}` in it is `format(x, ".3g")`."""
    return _templates(Path(module).parent / "templates").get_template(template).render(values).rstrip("\n")


@cache
def _templates(folder: Path) -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined  # few commands print such a text

    made = Environment(  # what is filled in is no HTML
        loader=FileSystemLoader(folder), undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    made.filters["fmt"] = format
    return made
