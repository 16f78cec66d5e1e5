"""The kinds of models by name."""

from collections.abc import Mapping
from typing import Any

import torch

from nsde_torch.errors import ConfigError
from nsde_torch.models.ensemble import EnsembleSpec, GaussianEnsemble
from nsde_torch.models.identified import IdentifiedModel, SysidSpec
from nsde_torch.models.model import Model, ModelSpec
from nsde_torch.models.neural_sde import NeuralSDE, SDESpec

_CLASSES: dict[type[ModelSpec], type[Model]] = {
    SDESpec: NeuralSDE,
    EnsembleSpec: GaussianEnsemble,
    SysidSpec: IdentifiedModel,
}
SPECS: dict[str, type[ModelSpec]] = {kind: spec for spec in _CLASSES for kind in spec.kinds}


def make_spec(values: Mapping[str, Any]) -> ModelSpec:
    """A specification from plain values, as `ModelSpec.as_dict` gives them.

    Raises:
        ConfigError: no such kind, an unknown key, or a value that cannot be.
    """
    kind = values.get("kind", "nsde")
    if kind not in SPECS:
        raise ConfigError(f"`model.kind` must be one of {', '.join(SPECS)}; got {kind!r}.")
    return SPECS[kind].from_dict(values)


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
    return _CLASSES[type(spec)](spec, generator=generator, values=values)
