"""Runs of the mass-spring-damper of the supplement: m = 1, b = 0.5, k = 1, five runs of 5 s at 100 Hz.

First states are uniform in [-0.1, 0.1] x [-0.1, 0.1] (the set D2); the force is zero, as there, or a random
multisine of 0.05 to 1.5 Hz (`Excitation`), which, unlike free decay, also shows the mass.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nsde_torch.data.raw import RawRun
from nsde_torch.errors import ConfigError
from nsde_torch.simulation.excitation import excited_runs
from nsde_torch.simulation.make import Making
from nsde_torch.systems.machines import machine

DURATIONS = (5.0,) * 5
REGION = ((-0.1, 0.1), (-0.1, 0.1))
"""Where runs start: bounds of q [m] and q_dot [m/s]."""
FORCES = ("zero", "multisine")
FORCE_SIZE = 0.05
"""Standard deviation of the multisine [N]."""


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
    return excited_runs(
        name,
        durations=DURATIONS if durations is None else durations,
        seed=seed,
        making=making,
        inputs=[force_size if force == "multisine" else 0.0],
        noise=machine(name).sensor_std,
        start=region,
    )
