"""Models and their specifications, from plain values."""

from collections.abc import Mapping
from typing import Any

import torch

from nsde_torch.models.kind import model_kind
from nsde_torch.models.model import Model, ModelSpec


def make_spec(values: Mapping[str, Any]) -> ModelSpec:
    """A specification from plain values, as `ModelSpec.as_dict` gives them.

    Raises:
        ConfigError: no such kind, an unknown key, or a value that cannot be.
    """
    return model_kind(str(values.get("kind", "nsde"))).spec.from_dict(values)


def make_model(
    spec: ModelSpec,
    *,
    generator: torch.Generator,
    values: Mapping[str, float | list[float]] | None = None,
) -> Model:
    """A model with fresh weights.

    Args:
        spec: What to build.
        generator: Source of the weights.
        values: Initial values of declared parameters.
    """
    make: Any = model_kind(spec.kind).model
    made: Model = make(spec, generator=generator, values=values)
    return made
