"""The battery of a multirotor: its voltage falls with what was drawn, and under load.

    V = 16.8 V - 3 V q - 1.2 V mean(u),     q' = mean(u) / (0.39 * 300 s)

Four cells from full to empty, a load of the commands' mean, and 300 s of hovering (mean(u) = 0.39) in a battery that
is no longer new. The runs of a data set are flown one after another on it; a run that would go beyond 90 % starts
with a full one.
"""

from collections.abc import Sequence
from typing import final

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.errors import ConfigError
from nsde_torch.simulation.make import Making
from nsde_torch.simulation.plant import Plant

COLUMN = "battery_voltage"
FULL, SWING, LOAD = 16.8, 3.0, 1.2  # voltage when full, what it loses until empty, and under full command [V]
HOVER, ENDURANCE = 0.39, 300.0  # command and time of hovering on one charge [s]
EMPTY = 0.9


@final
class Battery:
    """Batteries of a batch of machines, of whose charge a share is used at the start (B,); `dt` is the sample [s]."""

    def __init__(self, used: Sequence[float], *, dt: float, logged: bool) -> None:
        self._used = torch.tensor(list(used), dtype=torch.float64)[:, None]
        self._dt, self._logged = dt, logged

    def voltage(self, u: Tensor) -> Tensor:
        """Voltage under commands (B, nu): (B, 1), or (B, 0) where it is not logged."""
        if not self._logged:
            return u[:, :0]
        self._used = self._used.to(u)
        return FULL - SWING * self._used - LOAD * u.mean(1, keepdim=True)

    def use(self, u: Tensor) -> None:
        """Draw what commands (B, nu) need over a sample."""
        if self._logged:
            self._used = self._used + (self._dt / (HOVER * ENDURANCE)) * u.mean(1, keepdim=True)

    def seen_by(self, plant: Plant, u: Tensor, voltage: Tensor) -> Tensor:
        """What a plant takes: commands, and the voltage where an effect reads it."""
        return torch.cat((u, voltage), 1) if plant.system.exogenous else u


def battery_of(plant: Plant, making: Making, durations: Sequence[float], *, rows: int) -> Battery:
    """The batteries of a recording; row i is run i modulo the number of runs.

    A ConfigError where an effect reads another logged channel.
    """
    asked = plant.system.exogenous
    if set(asked) - {COLUMN}:
        raise ConfigError(
            f"effects of the plant read {', '.join(sorted(asked))}, and a simulated log has only {COLUMN!r}. Leave "
            "those effects out."
        )
    used, starts = 0.0, []
    for duration in durations:
        share = duration / ENDURANCE
        used = used if used + share <= EMPTY else 0.0
        starts.append(used)
        used += share
    logged = bool(asked) or making.battery
    return Battery([starts[i % len(starts)] for i in range(rows)], dt=plant.dt, logged=logged)


def used_of(voltage: Array, u: Array) -> Array:
    """Share of the charge that is spent (B,), from the voltage (B, 1) that was logged under commands (B, nu)."""
    return np.asarray((FULL - LOAD * u.mean(1) - voltage[:, 0]) / SWING)


def battery_column(voltage: Array) -> dict[str, Array]:
    """The voltage (n, 1) or (n, 0) of a run as a further column."""
    return {COLUMN: voltage[:, 0].copy()} if voltage.shape[1] else {}
