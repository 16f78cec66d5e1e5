"""Files that are written whole or not at all, whatever stops the program; results as JSON, whatever they hold."""

import json
from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from typing import Any


def write_whole(path: Path, text: str) -> None:
    """Write a text file, in place of the one that is there.

    Args:
        path: The file.
        text: What it is to hold.
    """
    part = path.with_name(f"{path.name}.part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)


def json_text(content: Any, *, indent: int | None = 1) -> str:
    """Plain containers as JSON, `null` for what is no finite number: an error of a prediction that has diverged.

    Args:
        content: Dictionaries, lists, tuples, texts, numbers, truth values, None.
        indent: See `json.dumps`.
    """
    return json.dumps(_of_finite_numbers(content), indent=indent, allow_nan=False)


def _of_finite_numbers(value: Any) -> Any:
    if isinstance(value, float):
        return value if isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _of_finite_numbers(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_of_finite_numbers(one) for one in value]
    return value
