"""A plate under a thin heater, which settles in a quarter of the time between two rows; simulated exactly."""

from collections.abc import Mapping
from typing import final

import numpy as np
import torch
from scipy.linalg import expm
from torch import Tensor

from nsde_torch.data import Run
from nsde_torch.effects import Parameter, Port
from nsde_torch.systems import Defaults, ResidualPort, System

HEATS, FAST, SHARED, LOSS = 2.0, 2.0, 0.02, 0.01
DT, FINE = 2.0, 40  # step of the log [s], and parts that it is simulated in
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


def heated(effect: str, late: float, *, noise: float = 0.02, seed: int = 0) -> list[Run]:
    """Runs whose power is drawn anew now and then, and acts late: by a lag of first order, or a delay [s]."""
    rng, h, runs = np.random.default_rng(seed), DT / FINE, []
    a = np.array([[-FAST, FAST, HEATS], [SHARED, -SHARED - LOSS, 0.0], [0.0, 0.0, 0.0]])
    step = expm(h * a)
    for number in range(3):
        n = 400
        u = np.repeat(rng.uniform(0.0, 5.0, n // 8 + 1), 8)[:n]
        fine = np.repeat(u, FINE)
        if effect == "input_delay":
            acts = np.concatenate([np.full(round(late / h), u[0]), fine])[: len(fine)]
        else:
            acts, m, keep = np.empty_like(fine), u[0], np.exp(-h / late)
            for k, now in enumerate(fine):
                later = now + (m - now) * keep
                acts[k], m = now + (m - now) * (1.0 - keep) * late / h, later  # its mean over the part
        warm = u[0] * HEATS / FAST  # of the heater above the plate
        z, rows = np.array([warm * (1.0 + SHARED / LOSS), warm * SHARED / LOSS]), []
        for k in range(len(fine)):
            if k % FINE == 0:
                rows.append(z + noise * rng.standard_normal(2))
            z = (step @ np.append(z, acts[k]))[:2]
        t = 10_000.0 * number + DT * np.arange(n, dtype=np.float64)
        runs.append(Run(f"run_{number}", t, np.array(rows), u[:, None]))
    return runs
