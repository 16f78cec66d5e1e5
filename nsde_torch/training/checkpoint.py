"""Checkpoints: tensors in safetensors, the rest in JSON beside them; written whole or not at all."""

import json
import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from nsde_torch.errors import CheckpointError


def write_checkpoint(path: Path, tensors: Mapping[str, Tensor], about: Mapping[str, Any]) -> None:
    """Write `path`.safetensors; `about` travels in its header, so that both are of one moment.

    Args:
        path: File without suffix; its folder is made.
        tensors: What to keep.
        about: JSON-able.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".partial")
    kept = {k: v.detach().cpu().contiguous().clone() for k, v in tensors.items()}
    save_file(kept, str(temporary), metadata={"about": json.dumps(about)})
    os.replace(temporary, path.with_suffix(".safetensors"))


def read_checkpoint(
    path: Path, expected: Mapping[str, Tensor], *, parts: Collection[str] = ("batches", "noise")
) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
    """Read a checkpoint; None if there is none.

    Args:
        path: File without suffix.
        expected: State dict of the model that it should be of.
        parts: Names of the further tensors that it must hold.

    Raises:
        CheckpointError: damaged, or of another model.
    """
    from safetensors import safe_open

    file = path.with_suffix(".safetensors")
    if not file.exists():
        return None
    try:
        tensors = load_file(str(file))
        with safe_open(str(file), framework="pt") as opened:
            about = json.loads((opened.metadata() or {})["about"])
    except (SafetensorError, KeyError, ValueError, OSError) as error:
        raise CheckpointError(f"checkpoint {file} is damaged ({error}). Remove it to start again.") from error
    kept = {k[5:] for k in tensors if k.startswith("kept.")}
    lost = set(parts) - set(tensors)
    if lost or kept != {k[6:] for k in tensors if k.startswith("model.")}:
        raise CheckpointError(f"checkpoint {file} is damaged (parts are missing). Remove it to start again.")
    shapes = {k[6:]: (v.shape, v.dtype) for k, v in tensors.items() if k.startswith("model.")}
    wanted = {k: (v.shape, v.dtype) for k, v in expected.items()}
    if shapes != wanted:
        differ = sorted(k for k in {*shapes, *wanted} if shapes.get(k) != wanted.get(k))
        raise CheckpointError(
            f"checkpoint {file} is of another model (they differ in {', '.join(differ[:5])}). Resume with the "
            "configuration of the run, or start a new one."
        )
    return tensors, about
