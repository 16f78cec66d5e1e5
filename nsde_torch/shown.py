"""How a result shows itself: preformatted in a notebook, and as a table of pandas."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from importlib import import_module
from typing import Any

from nsde_torch.errors import ConfigError


def preformatted(text: str) -> str:
    """HTML that keeps the columns of a text."""
    return f"<pre>{escape(text)}</pre>"


def data_frame(values: Any, names: Sequence[str] | None = None) -> Any:
    """A `pandas.DataFrame` of columns by name, or of rows with these names.

    Raises:
        ConfigError: pandas is not installed; nothing else here needs it.
    """
    try:
        pandas = import_module("pandas")
    except ImportError as error:
        raise ConfigError("`to_frame` needs pandas, which is not installed: pip install pandas.") from error
    return pandas.DataFrame(values, columns=names)
