"""A motor with the current of its coil, which no port pushes: a machine, and its exact runs."""

import numpy as np
import torch
from scipy.linalg import expm
from torch import Tensor

from nsde_torch.data import DataSet
from nsde_torch.data.raw import RawRun
from nsde_torch.effects import Coordinate, Parameter, Port
from nsde_torch.recording import assemble
from nsde_torch.systems import Defaults, ResidualPort, System

PULL, DRAG, BACK = 40.0, 0.6, 0.05
"""rad/s2 of an ampere, 1/s, and A (of a volt, over 1 ohm) of a rad/s."""
_NOISE, _GUST = (0.001, 0.05, 0.01), 1.0  # of sensors, and of torque [rad/s2]
_LASTS, _FINE = (0.1, 0.03), 20  # [s]; parts of a row of 10 ms


class CoilMotor(System):
    """q' = w, w' = pull i - drag w, i' = fast u - decay i - back w."""

    name = "coil_motor"
    state_names, state_units = ("q", "w", "i"), ("rad", "rad/s", "A")
    input_names, input_units = ("voltage",), ("V",)
    position_derivatives = (("q", "w", "world"),)
    ports = {Port.TORQUE: 1}
    coordinates = (Coordinate("shaft", "w", Port.TORQUE, position="q", kind="axis"),)
    residual_ports = {Port.TORQUE: ResidualPort(1, 1.0, "rad/s2")}
    defaults = Defaults(0.01, 25, (0.002, 0.05, 0.02), 0.1, 1.0, "euler_maruyama")
    sensor_noise = True
    PARAMETERS = {
        "pull": Parameter(30.0, "rad/(s2 A)", low=0.0),
        "drag": Parameter(1.0, "1/s", low=0.0),
        "fast": Parameter(200.0, "A/(s V)", low=0.0),
        "decay": Parameter(200.0, "1/s", low=0.0),
        "back": Parameter(10.0, "A/rad", low=0.0),
    }
    feature_names, feature_units = ("w", "i"), ("rad/s", "A")

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: dict[Port, Tensor]) -> Tensor:
        _, w, i = x.split(1, 1)
        turn = self.value("pull") * i - self.value("drag") * w + forces.get(Port.TORQUE, 0.0)
        rise = self.value("fast") * u - self.value("decay") * i - self.value("back") * w
        return torch.cat((w, turn, rise), 1)

    def features(self, x: Tensor) -> Tensor:
        return x[:, 1:]


def turns(
    seed: int, decay: float, *, friction: float = 0.0, ripple: float = 0.02, seconds: float = 20.0
) -> DataSet:
    """Three runs whose current settles in 1 / decay [s], exact over steps of 0.5 ms.

    With a dry friction [rad/s2] of tanh, and a ripple of the voltage [V] that nobody logs.
    """
    rng, rows, h = np.random.default_rng(seed), round(seconds / 0.01), 0.01 / _FINE
    rate = np.zeros((6, 6))  # of q, w, i, the input, and two gusts
    rate[0, 1] = 1.0
    rate[1, [1, 2, 4]] = -DRAG, PULL, 1.0
    rate[2, [1, 2, 3, 5]] = -decay * BACK, -decay, decay, decay
    rate[[4, 5], [4, 5]] = -1.0 / np.array(_LASTS)
    step, t, raw = expm(h * rate), 0.01 * np.arange(rows), []
    kick = np.array((_GUST, ripple)) * np.sqrt(1.0 - np.exp(-2.0 * h / np.array(_LASTS)))
    for name in ("a", "b", "c"):
        waves = np.sin(np.outer(t, 2 * np.pi * rng.uniform(0.1, 2.5, 7)) + rng.uniform(0.0, 6.0, 7)).sum(1)
        u = 0.7 * waves + np.repeat(rng.choice((-1.0, 1.0), rows // 90 + 1), 90)[:rows]
        z, x = np.zeros(6), np.empty((rows, 3))
        for k in range(rows):
            x[k], z[3] = z[:3], u[k]
            for _ in range(_FINE):
                z[1] -= h * friction * np.tanh(z[1] / 0.1)
                z = step @ z
                z[4:] += kick * rng.standard_normal(2)
        raw.append(RawRun(name, t, x + rng.normal(0.0, _NOISE, x.shape), u[:, None]))
    return assemble(raw, CoilMotor(), kind="simulated")
