"""Keys of the experiments of `nsde close-loop`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from nsde_torch.design.options import DesignOptions

from ..keys import key, of


@dataclass
class ExperimentConfig:
    """What an experiment may do, and how long it is looked for."""

    fence: Any = key(
        [[-3.5, 3.5], [-3.5, 3.5], [0.4, 4.0]],
        "lowest and highest x, y, z from the place of take-off that an experiment may reach",
        unit="m",
    )
    speed: float = key(4.0, "largest speed along each axis", unit="m/s", above=0)
    rate: float = key(4.0, "largest rate of turn about each axis", unit="rad/s", above=0)
    duration: float = key(12.0, "length of an experiment", unit="s", low=4)
    samples: int = of(DesignOptions, "samples", default=3)
    proposals: int | None = of(DesignOptions, "proposals", default=16)
    generations: int | None = of(DesignOptions, "generations", default=2)
    rehearsals: int = of(DesignOptions, "rehearsals", default=4)
    baselines: bool = key(
        True, "take a usual flight where none is better: lemniscate, doublets, the longest again"
    )
    least_nats: float = key(
        0.5, "an experiment with less expected evidence than this is not flown", unit="nats", low=0
    )
