"""Effects of the catalogue as candidates: which a system may have, and where their fits start."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from nsde_torch.effects import EFFECTS, Effect, Port, make_effect
from nsde_torch.systems import System

Array = NDArray[np.float64]
Start = Mapping[str, float | list[float]]


def candidate_names(system: System, exclude: Iterable[str] = ()) -> list[str]:
    """Names of the effects that could be missing from a system, whose channels the data have."""
    left_out = {*exclude, *system.effect_names}
    ports = {*system.ports, Port.INPUT}
    seen = set(system.exogenous)
    return sorted(
        name
        for name, cls in EFFECTS.items()
        if name not in left_out
        and cls.fits(system.name, ports)
        and all(system.quantities.get(q) == width for q, width in cls.quantities.items())
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
        scales: Sizes that grids are relative to, by name ("input", "speed", "position", "rate").
        frequencies: Where the residual has spectral lines [Hz], for what oscillates.
    """
    return list(EFFECTS[name].starts(scales, frequencies))
