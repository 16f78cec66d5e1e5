"""A motor with the current of its coil, which no port pushes: a machine, and its runs."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from nsde_torch.data import DataSet
from nsde_torch.effects import Coordinate, Parameter, Port
from nsde_torch.recording import assemble
from nsde_torch.systems import Defaults, ResidualPort, System
from tests.helpers.machines import Array, simulated

PULL, DRAG, BACK = 40.0, 0.6, 0.05
"""rad/s2 of an ampere, 1/s, and A (of a volt, over 1 ohm) of a rad/s."""
_NOISE, _GUST = (0.001, 0.05, 0.01), 1.0  # of sensors, and of torque [rad/s2]
_LASTS = 0.1, 0.03  # of gusts and of the ripple [s]


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
    seed: int,
    decay: float,
    *,
    friction: float = 0.0,
    ripple: float = 0.02,
    seconds: float = 20.0,
    late: int = 0,
) -> DataSet:
    """Three runs whose current settles in 1 / decay [s].

    With a dry friction [rad/s2] of tanh, a ripple of the voltage [V] that nobody logs, and a voltage that acts so many
    fifths of a row late.
    """
    rng, t, raw = np.random.default_rng(seed), 0.01 * np.arange(round(seconds / 0.01)), []

    def rates(x: Array, u: Array) -> list[float]:
        _, w, i, gust, wave = x
        turn = PULL * i - DRAG * w + gust - friction * np.tanh(w / 0.1)
        return [w, turn, decay * (u[0] + wave - BACK * w - i), -gust / _LASTS[0], -wave / _LASTS[1]]

    kick = np.array((0.0, 0.0, 0.0, _GUST * (2.0 / _LASTS[0]) ** 0.5, ripple * (2.0 / _LASTS[1]) ** 0.5))
    for number in range(3):
        waves = np.sin(np.outer(t, 2 * np.pi * rng.uniform(0.1, 2.5, 7)) + rng.uniform(0.0, 6.0, 7)).sum(1)
        u = 0.7 * waves + np.repeat(rng.choice((-1.0, 1.0), len(t) // 90 + 1), 90)[: len(t)]
        parts = 5 if late else 1
        how = {"noise": (*_NOISE, 0.0, 0.0), "kick": kick, "rng": rng, "fine": 20 // parts}
        acts = np.repeat(u, parts)[(np.arange(parts * len(u)) - late).clip(0), None]
        run = simulated(number, rates, np.zeros(5), acts, 0.01 / parts, **how)
        raw.append(replace(run, t=run.t[::parts], x=run.x[::parts, :3], u=u[:, None]))
    return assemble(raw, CoilMotor(), kind="simulated")


def follows(seed: int, decay: float, *, friction: float = 0.0, seconds: float = 20.0) -> DataSet:
    """Three runs of a servo that follows slow waves by its logged angle and speed; rates are those of `turns`."""
    rng, t, raw = np.random.default_rng(seed), 0.01 * np.arange(round(seconds / 0.01)), []

    def rates(x: Array, u: Array) -> list[float]:
        _, w, i, gust = x
        turn = PULL * i - DRAG * w + gust - friction * np.tanh(w / 0.1)
        return [w, turn, decay * (u[0] - BACK * w - i), -gust / _LASTS[0]]

    kick = np.array((0.0, 0.0, 0.0, _GUST * (2.0 / _LASTS[0]) ** 0.5))
    for number in range(3):
        waves = np.sin(np.outer(t, 2 * np.pi * rng.uniform(0.1, 0.6, 5)) + rng.uniform(0.0, 6.0, 5)).sum(1)
        how = {"noise": (*_NOISE, 0.0), "kick": kick, "rng": rng, "fine": 20}
        how["control"] = lambda wanted, seen: 9.0 * (wanted - seen[0]) - 0.15 * seen[1]
        run = simulated(number, rates, np.zeros(4), waves[:, None], 0.01, **how)
        raw.append(replace(run, x=run.x[:, :3]))
    return assemble(raw, CoilMotor(), kind="simulated")
