"""An electric car on a stiff tyre, whose slip is mostly noise of its two speeds: a machine, and its exact runs."""

import numpy as np
import torch
from scipy.linalg import expm
from torch import Tensor

from nsde_torch.data import DataSet
from nsde_torch.data.raw import RawRun
from nsde_torch.effects import Coordinate, Parameter, Port
from nsde_torch.recording import assemble
from nsde_torch.systems import Defaults, ResidualPort, System

CAR, WHEEL, TYRE, LAG_S = 0.96, 12.5, 4.2, 0.05
TRUTH, LAG = {"car": CAR, "wheel": WHEEL, "tyre": TYRE}, {"time_constant": LAG_S}
_NOISE, _PROCESS, _FINE = (0.03, 0.04), (0.03, 0.05), 10


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
    """Three drives whose torque acts behind a lag, logged every 10 ms: exact over steps of 1 ms."""
    rng, dt, rows, fine = np.random.default_rng(seed), 0.01, round(seconds / 0.01), 0.01 / _FINE
    late = 1.0 / lag
    rate = np.zeros((4, 4))
    rate[0, :2] = -CAR * TYRE, CAR * TYRE
    rate[1, :3] = WHEEL * TYRE, -WHEEL * TYRE, WHEEL
    rate[2, 2:] = -late, late
    step, raw = expm(rate * fine), []
    for name in ("a", "b", "c"):
        t, size = dt * np.arange(rows), rng.uniform(0.5, 1.0, 7)
        waves = np.sin(np.outer(t, 2 * np.pi * rng.uniform(0.05, 1.5, 7)) + rng.uniform(0.0, 6.0, 7))
        held = np.repeat(rng.standard_normal(rows // 45 + 1), 45)[:rows]
        u, z = 0.6 * (waves @ size) + 0.5 * held, np.array([20.0, 20.0, 0.0])
        x = np.empty((rows, 2))
        for k in range(rows):
            x[k] = z[:2]
            for _ in range(_FINE):
                z = step[:3, :3] @ z + step[:3, 3] * u[k]
                z[:2] += fine**0.5 * np.array(_PROCESS) * rng.standard_normal(2)
        raw.append(RawRun(name, t, x + np.array(_NOISE) * rng.standard_normal((rows, 2)), u[:, None]))
    return assemble(raw, Tyre(), kind="simulated")
