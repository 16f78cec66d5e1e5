"""Closed loops of one plant as recordings: all runs in one batch, each cut to its own length."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from nsde_torch.arrays import Array
from nsde_torch.data.raw import RawRun
from nsde_torch.errors import ConfigError
from nsde_torch.simulation.plant import Plant

Control = Callable[[float, torch.Tensor], torch.Tensor]


def record(
    plant: Plant, start: Array, control: Control, *, durations: Sequence[float], prefix: str
) -> list[RawRun]:
    """Runs of a plant under a controller.

    Args:
        plant: The machines.
        start: First true states (B, nx).
        control: Commands (B, nu) from the time [s] and the measured states (B, nx).
        durations: Length of each run [s], at least one sample.
        prefix: Runs are named `prefix_0`, `prefix_1`, ...

    Returns:
        One run for each row: measured states, and the command given at each, which holds to the next.

    Raises:
        ConfigError: no duration, or one shorter than a sample.
    """
    if not len(durations) or min(durations) < plant.dt:
        raise ConfigError(
            f"`durations` must be one or more times of {plant.dt:g} s or longer; got {list(durations)}."
        )
    rows = [round(d / plant.dt) + 1 for d in durations]
    x = plant.reset(torch.as_tensor(start), torch.zeros(len(start), plant.system.nu))
    states, commands = [x], []
    for k in range(max(rows)):
        u = control(k * plant.dt, x)
        commands.append(u)
        if k + 1 < max(rows):
            x = plant.step(u)
            states.append(x)
    xs, us = torch.stack(states).cpu().numpy(), torch.stack(commands).cpu().numpy()
    digits = len(str(len(rows) - 1))
    return [
        RawRun(
            f"{prefix}_{i:0{digits}d}",
            plant.dt * np.arange(n, dtype=np.float64),
            xs[:n, i].copy(),
            us[:n, i].copy(),
            source="simulated",
        )
        for i, n in enumerate(rows)
    ]
