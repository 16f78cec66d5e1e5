"""Run directories: `config.yaml` says what the model is, `model.safetensors` holds its numbers. No pickle."""

import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
import yaml
from safetensors import SafetensorError

from nsde_torch.errors import CheckpointError, ConfigError, NsdeError
from nsde_torch.models.kind import model_kind
from nsde_torch.models.model import Model, ModelSpec
from nsde_torch.systems.values import Values
from nsde_torch.whole_files import read_tensors, write_tensors


def make_spec(values: Mapping[str, Any]) -> ModelSpec:
    """A specification from plain values, as `ModelSpec.as_dict` gives them.

    A ConfigError where there is no such kind, a key is unknown, or a value cannot be.
    """
    return model_kind(str(values.get("kind", "nsde"))).spec.from_dict(values)


def make_model(spec: ModelSpec, *, generator: torch.Generator, values: Values | None = None) -> Model:
    """A model with fresh weights from `generator`, and initial values of declared parameters."""
    make: Any = model_kind(spec.kind).model
    made: Model = make(spec, generator=generator, values=values)
    return made


CONFIG, WEIGHTS, METRICS = "config.yaml", "model.safetensors", "metrics.json"
_FORMAT = "nsde_torch/1"
_DAMAGE = (yaml.YAMLError, SafetensorError, OSError, LookupError, TypeError, ValueError, RecursionError)


def save(model: Model, run_dir: str | Path, *, about: Mapping[str, Any] | None = None) -> None:
    """Write a model into a folder, made if need be; `about` are further plain values for `config.yaml`."""
    folder = Path(run_dir)
    folder.mkdir(parents=True, exist_ok=True)
    text = yaml.safe_dump({"format": _FORMAT, "spec": model.spec.as_dict(), **(about or {})}, sort_keys=False)
    (folder / CONFIG).write_text(text)
    write_tensors(folder / WEIGHTS, model.state_dict(), {"format": _FORMAT})


def load(run_dir: str | Path, *, device: str | torch.device = "cpu") -> Model:
    """The model of a run directory, in evaluation mode, without gradients; `model.metrics` is its `metrics.json`.

    A system of the user's own is imported by the name that `config.yaml` gives: load run directories that you trust.

    Args:
        run_dir: Folder that `nsde train` wrote.
        device: Where to put it.

    Raises:
        CheckpointError: the folder or a file in it is missing, damaged or from another version.

    Example:
        >>> model = load("runs/hexacopter")  # doctest: +SKIP
        >>> x = model.sample(x0, u, dt=0.05, particles=32, generator=torch.Generator())  # doctest: +SKIP
    """
    folder = Path(run_dir)
    if not folder.is_dir():
        raise CheckpointError(f"no run directory {folder}; give the folder that `nsde train` printed.")
    for name in (CONFIG, WEIGHTS):
        if not (folder / name).is_file():
            raise CheckpointError(
                f"{folder} holds no {name}; it is no run directory, or its training has not finished "
                f"(`nsde train {shlex.quote(f'resume={folder}')}` finishes it)."
            )
    try:
        config = yaml.safe_load((folder / CONFIG).read_text())
        if not isinstance(config, dict) or config.get("format") != _FORMAT:
            raise CheckpointError(
                f"{folder / CONFIG} is not of the format {_FORMAT}; another version wrote it."
            )
        if not isinstance(config["spec"], dict):
            raise CheckpointError(f"{folder / CONFIG} holds no specification of a model. Train again.")
        spec = make_spec(config["spec"])
        tensors, header = read_tensors(folder / WEIGHTS)
        if header.get("format") != _FORMAT:
            raise CheckpointError(f"{folder / WEIGHTS} is not of the format {_FORMAT}.")
    except ConfigError as error:
        raise CheckpointError(f"{folder / CONFIG}: {error}") from error
    except _DAMAGE as error:
        raise CheckpointError(f"run directory {folder} is damaged ({error}). Train again.") from error
    try:
        model = make_model(spec, generator=torch.Generator().manual_seed(0))
    except (NsdeError, TypeError, ValueError, RuntimeError, AttributeError) as error:
        raise CheckpointError(f"{folder / CONFIG} describes no model that can be built: {error}") from error
    wanted = {k: tuple(v.shape) for k, v in model.state_dict().items()}
    found = {k: tuple(v.shape) for k, v in tensors.items()}
    if wanted != found:
        differ = sorted(k for k in {*wanted, *found} if wanted.get(k) != found.get(k))
        raise CheckpointError(
            f"{folder / WEIGHTS} does not fit {CONFIG} (they differ in {', '.join(differ[:5])}). Train again."
        )
    broken = sorted(k for k, v in tensors.items() if not bool(torch.isfinite(v).all()))
    if broken:
        raise CheckpointError(
            f"{folder / WEIGHTS} holds numbers that are not finite ({', '.join(broken[:5])}). Train again."
        )
    model.to(dtype=tensors["clock_scale"].dtype).load_state_dict(tensors)
    model.folder = folder
    model.metrics = read_metrics(folder) if (folder / METRICS).is_file() else {}
    return model.to(device).eval().requires_grad_(False)


def read_metrics(folder: Path) -> Mapping[str, Any]:
    """The content of the `metrics.json` of a run directory; a CheckpointError where it is damaged."""
    called = folder / METRICS
    try:
        content = json.loads(called.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CheckpointError(f"{called} is damaged ({error}). Train again.") from error
    if not isinstance(content, dict):
        raise CheckpointError(f"{called} is damaged. Train again.")
    return content
