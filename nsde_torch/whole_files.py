"""Files that are written whole or not at all, whatever stops the program; results as JSON, whatever they hold."""

from __future__ import annotations

import json
from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor


def write_whole(path: Path, text: str) -> None:
    """Write a text file, in place of the one that is there."""
    part = path.with_name(f"{path.name}.part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)


def read_json(path: Path, default: Any = None) -> Any:
    """What a JSON file holds; the default where there is no file."""
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else default


def write_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, str]) -> None:
    """Write a safetensors file with texts in its header, in place of the one that is there."""
    from safetensors.torch import save_file

    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.partial")
    save_file({k: v.detach().cpu().contiguous().clone() for k, v in tensors.items()}, str(part), dict(header))
    part.replace(path)


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and header of a safetensors file."""
    from safetensors import safe_open
    from safetensors.torch import load_file

    with safe_open(str(path), framework="pt") as opened:
        header = opened.metadata() or {}
    return load_file(str(path)), header


def json_text(content: Any, *, indent: int | None = 1) -> str:
    """Plain containers as JSON, `null` for what is no finite number: an error of a prediction that has diverged."""
    return json.dumps(finite(content), indent=indent, allow_nan=False)


def finite(value: Any) -> Any:
    """Plain containers, with None for what is no finite number."""
    if isinstance(value, float):
        return value if isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: finite(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(one) for one in value]
    return value
