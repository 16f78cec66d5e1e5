"""Runs of the mass-spring-damper of the supplement: m = 1, b = 0.5, k = 1, five runs of 5 s at 100 Hz.

First states are uniform in [-0.1, 0.1] x [-0.1, 0.1] (the set D2); the force is zero, as there, or a random
multisine

    F(t) = sum_k A sin(2 pi f_k t + phi_k),   f_k log-uniform in 0.05 to 1.5 Hz,

which, unlike free decay, also shows the mass.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import pi

import numpy as np
import torch

from nsde_torch.data.raw import RawRun
from nsde_torch.errors import ConfigError
from nsde_torch.simulation.make import Making, record

DURATIONS = (5.0,) * 5
REGION = ((-0.1, 0.1), (-0.1, 0.1))
"""Where runs start: bounds of q [m] and q_dot [m/s]."""
FORCES = ("zero", "multisine")
SINES, FORCE_SIZE = 6, 0.05
"""Number of sines of the multisine, and the standard deviation of their sum [N]."""


def spring_runs(
    name: str = "mass_spring_damper",
    *,
    durations: Sequence[float] | None = None,
    seed: int,
    force: str = "zero",
    force_size: float = FORCE_SIZE,
    making: Making = Making(),
    region: Sequence[Sequence[float]] = REGION,
) -> list[RawRun]:
    """Runs of the mass-spring-damper.

    Args:
        name: System.
        durations: Length of each run [s]; default: five of 5 s.
        seed: Seed of first states, force and noise.
        force: `zero` or `multisine`.
        force_size: Standard deviation of the multisine [N].
        making: Effects and noise of the plant, and how it is made.
        region: Where runs start, ((lowest q, highest q), (lowest q_dot, highest q_dot)).

    Returns:
        Runs at 100 Hz (or on the step of `making`): measured q, q_dot and the force.

    Raises:
        ConfigError: an unknown choice or effect, or a number out of range.
    """
    if force not in FORCES:
        raise ConfigError(f"`force` must be one of {', '.join(FORCES)}; got {force!r}.")
    if not force_size > 0:
        raise ConfigError(f"`force_size` must be above 0 N; got {force_size!r}.")
    bounds = np.asarray(region, dtype=np.float64)
    if bounds.shape != (2, 2) or (bounds[:, 1] < bounds[:, 0]).any():
        raise ConfigError(f"`region` must be ((low, high), (low, high)) of q and q_dot; got {region!r}.")
    lengths = DURATIONS if durations is None else durations
    rng = np.random.default_rng([seed, 1])
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    plant = making.plant(name, generator=generator)
    start = rng.uniform(bounds[:, 0], bounds[:, 1], (len(lengths), 2))
    hertz = np.exp(rng.uniform(np.log(0.05), np.log(1.5), (len(lengths), SINES)))
    phase = rng.uniform(0.0, 2.0 * pi, (len(lengths), SINES))
    size = force_size * np.sqrt(2.0 / SINES) if force == "multisine" else 0.0

    def control(t: float, x: torch.Tensor) -> torch.Tensor:
        waves = size * np.sin(2.0 * pi * hertz * t + phase)
        return torch.as_tensor(waves.sum(axis=1, keepdims=True))

    return record(plant, start, control, durations=lengths, prefix="run")
