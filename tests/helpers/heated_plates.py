"""A plate under a thin heater, which settles in a quarter of the time between two rows."""

from collections.abc import Mapping
from typing import final

import numpy as np
import torch
from torch import Tensor

from nsde_torch.data import Run
from nsde_torch.effects import Parameter, Port
from nsde_torch.systems import Defaults, ResidualPort, System
from tests.helpers.machines import Array, held, simulated

HEATS, FAST, SHARED, LOSS = 2.0, 2.0, 0.02, 0.01
DT = 2.0  # step of the log [s]
HEAT = Port("heat")


@final
class Plate(System):
    """heater' = heats u - fast (heater - plate); plate' = shared (heater - plate) - loss plate."""

    name = "plate"
    state_names, state_units = ("heater", "plate"), ("K", "K")
    input_names, input_units = ("power",), ("W",)
    ports = {HEAT: 2}
    residual_ports = {HEAT: ResidualPort(2, 0.1, "K/s")}
    sensor_noise = True
    defaults = Defaults(DT, 20, (0.05, 0.05), 0.1, 1.0, "euler_maruyama")
    PARAMETERS = {
        "heats": Parameter(HEATS, "K/(s W)", low=0.0),
        "fast": Parameter(FAST, "1/s", low=0.0),
        "shared": Parameter(SHARED, "1/s", low=0.0),
        "loss": Parameter(LOSS, "1/s", low=0.0),
    }

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        over = x[:, :1] - x[:, 1:]
        heater = self.value("heats") * u - self.value("fast") * over
        plate = self.value("shared") * over - self.value("loss") * x[:, 1:]
        return torch.cat((heater, plate), 1) + forces.get(HEAT, 0.0)


def heated(effect: str, late: int, *, noise: float = 0.02, seed: int = 0) -> list[Run]:
    """Runs whose power is drawn anew now and then, and acts late: by a lag of first order, or a delay [s]."""
    rng, runs, lags = np.random.default_rng(seed), [], effect == "actuator_lag"

    def rates(x: Array, u: Array) -> list[float]:
        power, over = x[2] if lags else u[0], x[0] - x[1]
        rise = (u[0] - x[2]) / late
        return [HEATS * power - FAST * over, SHARED * over - LOSS * x[1], rise]

    for number in range(3):
        u = held(rng, 0.0, 5.0, 800, each=16)
        acts = u if lags else u[(np.arange(len(u)) - late).clip(0)]
        warm = u[0, 0] * HEATS / FAST  # of the heater above the plate
        start = [warm * (1.0 + SHARED / LOSS), warm * SHARED / LOSS, u[0, 0]]
        run = simulated(number, rates, start, acts, 0.5 * DT, noise=(noise, noise, 0.0), rng=rng, fine=20)
        runs.append(Run(run.name, run.t[::2], run.x[::2, :2], u[::2]))
    return runs
