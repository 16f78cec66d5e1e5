"""Effects of the catalogue as candidates: which a system may have, and where their fits start."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from nsde_torch.effects import EFFECTS, Effect, Port, make_effect
from nsde_torch.systems import System

Array = NDArray[np.float64]
Start = Mapping[str, float]


def candidate_names(system: System, exclude: Iterable[str] = ()) -> list[str]:
    """Names of the effects that could be missing from a system, whose channels the data have."""
    left_out = {*exclude, *system.effect_names}
    ports = {*system.ports, Port.INPUT}
    seen = set(system.exogenous)
    return sorted(
        name
        for name, cls in EFFECTS.items()
        if name not in left_out
        and cls.port in ports
        and cls.fits(system.name)
        and cls.candidate(system.name)
        and set(cls.exogenous) <= seen
        and not left_out & set(cls.includes)
    )


def make_candidate(name: str, system: System, start: Start) -> Effect:
    """An effect with these values, for a copy of the system."""
    return make_effect(
        name, system=system.name, ports={*system.ports, Port.INPUT}, n_inputs=system.nu, values=dict(start)
    )


def starts(name: str, scales: Mapping[str, float], frequencies: Sequence[float]) -> list[Start]:
    """Values that fits start from: no effect, at every point of a grid of what enters nonlinearly.

    Args:
        name: Of the effect.
        scales: Size of what a grid is relative to, by name ("input").
        frequencies: Where the residual has spectral lines [Hz], for what oscillates.
    """
    cls = EFFECTS[name]
    scale = scales.get(cls.shape_scale, 1.0) if cls.shape_scale else 1.0
    grids = {k: tuple(scale * v for v in values) for k, values in cls.shapes.items()}
    if "frequency" in cls.PARAMETERS:
        grids["frequency"] = tuple(frequencies)
    points = product(*grids.values())
    return [{**cls.null, **dict(zip(grids, point, strict=True))} for point in points]
