"""An electric car on a stiff tyre, whose slip is mostly noise of its two speeds: a machine, and its runs."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from nsde_torch.data import DataSet
from nsde_torch.effects import Coordinate, Parameter, Port
from nsde_torch.recording import assemble
from nsde_torch.systems import Defaults, ResidualPort, System
from tests.helpers.machines import Array, simulated

CAR, WHEEL, TYRE, LAG_S = 0.96, 12.5, 4.2, 0.05
TRUTH, LAG = {"car": CAR, "wheel": WHEEL, "tyre": TYRE}, {"time_constant": LAG_S}


class Tyre(System):
    """v' = car f, rim' = wheel (torque - f), f = tyre (rim - v): speed of the car and of the rim [m/s]."""

    name = "tyre"
    state_names, state_units = ("v", "rim"), ("m/s", "m/s")
    input_names, input_units = ("torque",), ("kN",)
    ports = {Port.FORCE: 2}
    coordinates = (Coordinate("car", "v", Port.FORCE, row=0), Coordinate("wheel", "rim", Port.FORCE, row=1))
    residual_ports = {Port.FORCE: ResidualPort(2, 1.0, "m/s2")}
    defaults = Defaults(0.01, 25, (0.05, 0.2), 0.1, 1.0, "euler_maruyama")
    sensor_noise = True
    PARAMETERS = {
        "car": Parameter(0.8, "1/Mg", low=0.0),
        "wheel": Parameter(10.0, "1/Mg", low=0.0),
        "tyre": Parameter(4.0, "kN s/m", low=0.0),
    }

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: dict[Port, Tensor]) -> Tensor:
        f = self.value("tyre") * (x[:, 1:] - x[:, :1])
        rates = torch.cat((self.value("car") * f, self.value("wheel") * (u - f)), 1)
        return rates + forces.get(Port.FORCE, 0.0)


def drives(seed: int, *, lag: float = LAG_S, seconds: float = 30.0) -> DataSet:
    """Three drives whose torque acts behind a lag, logged every 10 ms."""
    rng, t, raw = np.random.default_rng(seed), 0.01 * np.arange(round(seconds / 0.01)), []

    def rates(x: Array, u: Array) -> list[float]:
        f = TYRE * (x[1] - x[0])
        return [CAR * f, WHEEL * (x[2] - f), (u[0] - x[2]) / lag]

    how = {"noise": (0.03, 0.04, 0.0), "kick": (0.03, 0.05, 0.0), "rng": rng}
    for number in range(3):
        size = rng.uniform(0.5, 1.0, 7)
        waves = np.sin(np.outer(t, 2 * np.pi * rng.uniform(0.05, 1.5, 7)) + rng.uniform(0.0, 6.0, 7))
        steps = np.repeat(rng.standard_normal(len(t) // 45 + 1), 45)[: len(t)]
        u = 0.6 * (waves @ size) + 0.5 * steps
        run = simulated(number, rates, [20.0, 20.0, 0.0], u[:, None], 0.01, **how)
        raw.append(replace(run, x=run.x[:, :2]))
    return assemble(raw, Tyre(), kind="simulated")
