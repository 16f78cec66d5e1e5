"""Machines of a user's own and runs of them, whose simulators share no code with the package: boats, a car, motors."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nsde_torch.data import RawRun
from nsde_torch.effects import Coordinate, Parameter, Port
from nsde_torch.systems import Defaults, ResidualPort, System
from tests.helpers.machines import Array, held, simulated

Torque = Callable[[float, float], float]
"""Of an angle and its speed."""


def turned(torque: Torque, *, seconds: float, dt: float, size: float) -> list[RawRun]:
    """Three runs in which torques of 0.3 to 1.2 s turn the pendulum; `torque` of angle and speed acts on it, too."""

    def rates(x: Array, u: Array) -> list[float]:
        return [x[1], 12.0 * u[0] - 9.0 * np.sin(x[0]) - 0.2 * x[1] + torque(x[0], x[1])]

    runs = []
    for seed in range(3):
        rng, rows = np.random.default_rng(seed), round(seconds / dt)
        lasts = rng.uniform(0.3, 1.2, round(4 * seconds)) / dt
        u = np.repeat(rng.uniform(-size, size, len(lasts)), lasts.astype(int))[:rows, None]
        start = [rng.uniform(-1.0, 1.0), 0.0]
        runs.append(simulated(seed, rates, start, u, dt, noise=(0.001, 0.005), rng=rng))
    return runs


class Car(System):
    """The speed of a car, which has no position."""

    name = "car"
    state_names, state_units = ("v",), ("m/s",)
    input_names, input_units = ("throttle",), ("1",)
    ports = {Port.FORCE: 1}
    residual_ports = {Port.FORCE: ResidualPort(1, 1.0, "m/s2")}
    sensor_noise = True
    defaults = Defaults(0.05, 20, (0.05,), 0.1, 1.0, "euler_maruyama")
    PARAMETERS = {"engine": Parameter(3.0, "m/s2", low=0.0), "rolling": Parameter(0.1, "m/s2", low=0.0)}

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        pushed = self.value("engine") * u - self.value("rolling")
        return pushed + forces.get(Port.FORCE, 0.0)


def driven() -> list[RawRun]:
    """Runs of a car in slow and noisy rows."""
    rng = np.random.default_rng(0)
    inputs = [held(rng, 0.0, 0.1, 1800, each=45) for _ in range(3)]
    how = {"noise": 0.05, "rng": rng, "fine": 1}
    return [simulated(k, lambda v, u: 3.5 * u - 0.15, [15.0], u, 0.05, **how) for k, u in enumerate(inputs)]


class Motor(System):
    """The speed of a motor."""

    name = "motor"
    state_names, state_units = ("omega",), ("rad/s",)
    input_names, input_units = ("voltage",), ("V",)
    ports = {Port.TORQUE: 1}
    residual_ports = {Port.TORQUE: ResidualPort(1, 10.0, "rad/s2")}
    sensor_noise = True
    defaults = Defaults(0.02, 25, (0.5,), 0.1, 1.0, "euler_maruyama")
    PARAMETERS = {"damping": Parameter(10.0, "1/s", low=0.0), "gain": Parameter(30.0, "rad/(s2 V)", low=0.0)}

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        free = self.value("gain") * u - self.value("damping") * x
        return free + forces.get(Port.TORQUE, 0.0)


class Rotor(System):
    """omega' = gain torque + pull wind - damping omega."""

    name = "rotor"
    state_names, state_units = ("omega",), ("rad/s",)
    input_names, input_units = ("torque", "wind"), ("N m", "m/s")
    ports = {Port("accel"): 1}
    residual_ports = {Port("accel"): ResidualPort(1, 0.1, "rad/s2")}
    sensor_noise = True
    defaults = Defaults(0.05, 20, (0.01,), 0.1, 1.0, "euler_maruyama")
    PARAMETERS = {name: Parameter(1.0, "1", low=0.0) for name in ("gain", "pull", "damping")}

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        moved = self.value("gain") * u[:, :1] + self.value("pull") * u[:, 1:]
        return moved - self.value("damping") * x + forces.get(Port("accel"), 0.0)


class Boat(System):
    """Surge, sway and turn of a boat with two propellers."""

    name = "boat"
    state_names, state_units = ("surge", "sway", "turn"), ("m/s", "m/s", "rad/s")
    input_names, input_units = ("port_side", "starboard"), ("N", "N")
    ports = {Port.FORCE: 2, Port.TORQUE: 1}
    coordinates = (
        Coordinate("surge", "surge", Port.FORCE, row=0),
        Coordinate("sway", "sway", Port.FORCE, row=1),
        Coordinate("turn", "turn", Port.TORQUE),
    )
    residual_ports = {Port.FORCE: ResidualPort(2, 0.1, "m/s2"), Port.TORQUE: ResidualPort(1, 0.1, "rad/s2")}
    sensor_noise = True
    defaults = Defaults(0.05, 20, (0.01, 0.01, 0.01), 0.1, 1.0, "euler_maruyama")
    PARAMETERS = {
        "thrust": Parameter(0.05, "1/kg", low=0.0),
        "lever": Parameter(0.03, "rad/(s2 N)", low=0.0),
        "drag": Parameter(0.4, "1/s", low=0.0),
    }

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        left, right = u[:, :1], u[:, 1:2]
        thrust, turn = self.value("thrust") * (left + right), self.value("lever") * (right - left)
        rates = torch.cat((thrust, torch.zeros_like(thrust), turn), 1) - self.value("drag") * x
        force, torque = forces.get(Port.FORCE, 0.0 * x[:, :2]), forces.get(Port.TORQUE, 0.0 * x[:, :1])
        return rates + torch.cat((force, torque), 1)


def sailed(
    strength: tuple[float, float] = (1.0, 1.0), *, sideways: float = 0.0, slip: float = 0.0, late: int = 0
) -> list[RawRun]:
    """Three runs of the boat: what each propeller gives, their force to the side [1/kg], drag of a turn [1/rad].

    `late` is how many rows later than logged starboard acts.
    """
    runs = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.uniform(5.0, 40.0, (40, 2)), 15, axis=0)
        acts = u * strength
        acts[:, 1] = acts[(np.arange(len(u)) - late).clip(0), 1]

        def rates(x: Array, u: Array) -> Array:
            pushed = np.array([0.055 * u.sum(), sideways * u.sum(), 0.028 * (u[1] - u[0])])
            return pushed - 0.45 * x - np.array([slip * abs(x[2]) * x[0], 0.0, 0.0])

        run = simulated(seed, rates, [0.0] * 3, acts, 0.05, noise=0.01, rng=rng)
        runs.append(replace(run, u=u))
    return runs


DRAG, TURN = (0.3, 0.8), 0.4


class Ship(System):
    """A ship that is pushed and turned, its velocities through the water."""

    name = "ship"
    state_names, state_units = ("x", "y", "psi", "u", "r"), ("m", "m", "rad", "m/s", "rad/s")
    input_names, input_units = ("thrust", "rudder"), ("1", "rad")
    position_derivatives = (("psi", "r", "world"),)
    ports = {Port.FORCE: 1, Port.TORQUE: 1}
    coordinates = (
        Coordinate("surge", "u", Port.FORCE, kind="rail"),
        Coordinate("yaw", "r", Port.TORQUE, position="psi", kind="axis"),
    )
    residual_ports = {Port.FORCE: ResidualPort(1, 0.1, "m/s2"), Port.TORQUE: ResidualPort(1, 0.1, "rad/s2")}
    defaults = Defaults(0.1, 20, (0.02, 0.02, 0.01, 0.02, 0.02), 0.1, 1.0, "euler_maruyama")
    sensor_noise = True
    PARAMETERS = {
        "surge_drag": Parameter(DRAG[0], "1/s", low=0.0),
        "yaw_drag": Parameter(DRAG[1], "1/s", low=0.0),
        "turn": Parameter(TURN, "1/s2"),
    }

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        psi, speed, rate = x[:, 2:3], x[:, 3:4], x[:, 4:5]
        along = u[:, :1] - self.value("surge_drag") * speed + forces.get(Port.FORCE, 0.0)
        turning = self.value("turn") * u[:, 1:] - self.value("yaw_drag") * rate + forces.get(Port.TORQUE, 0.0)
        return torch.cat((speed * torch.cos(psi), speed * torch.sin(psi), rate, along, turning), 1)


def voyages(current: tuple[float, float]) -> list[RawRun]:
    """Runs of a ship in water that flows."""
    rng, start = np.random.default_rng(11), [0.0, 0.0, 0.3, 0.5, 0.0]

    def rates(x: Array, u: Array) -> list[float]:
        _, _, psi, speed, rate = x
        moved = [speed * np.cos(psi) + current[0], speed * np.sin(psi) + current[1]]
        return [*moved, rate, u[0] - DRAG[0] * speed, TURN * u[1] - DRAG[1] * rate]

    inputs = (np.hstack([held(rng, a, b, 600, each=30) for a, b in ((0.1, 0.6), (-1, 1))]) for _ in range(3))
    return [simulated(k, rates, start, u, 0.1, noise=0.02, rng=rng, fine=4) for k, u in enumerate(inputs)]


class Lift(System):
    """A ball under an electromagnet: z'' = g - k (i / z)^2, z the gap."""

    name = "lift"
    state_names, state_units = ("z", "z_dot"), ("m", "m/s")
    input_names, input_units = ("current",), ("A",)
    position_derivatives = (("z", "z_dot", "world"),)
    ports = {Port.FORCE: 1}
    residual_ports = {Port.FORCE: ResidualPort(1, 0.3, "m/s2")}
    defaults = Defaults(0.005, 20, (1e-5, 1e-3), 0.1, 1.0, "euler_maruyama")
    sensor_noise = True
    PARAMETERS = {"pull": Parameter(1e-3, "m3/(s2 A2)", low=0.0)}

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        falls = 9.81 - self.value("pull") * (u / x[:, :1]) ** 2
        return torch.cat((x[:, 1:], falls + forces.get(Port.FORCE, 0.0)), 1)


def lifted(*, bias: float) -> list[RawRun]:
    """Runs whose gap reads too much [m]: two laws, an inertia and a stop stood for 1.28 mm of it."""
    rng, dt, runs = np.random.default_rng(5), 0.005, []

    def held_up(wanted: Array, seen: Array) -> Array:
        lift = 9.81 + 900.0 * (seen[0] - wanted) + 45.0 * seen[1]
        return np.sqrt(lift.clip(0.0) / 1.2e-3) * seen[0]

    def rates(x: Array, u: Array) -> list[float]:
        return [x[1], 9.81 - 1.2e-3 * (u[0] / x[0]) ** 2]

    for run in range(3):
        t, phases = dt * np.arange(1600), rng.uniform(0.0, 6.0, 3)
        waves = np.sin(2.0 * np.pi * rng.uniform(0.2, 1.5, (3, 1)) * t + phases[:, None])
        z = 0.012 + 0.0012 * waves.sum(0)[:, None]
        made = simulated(run, rates, [z[0, 0], 0.0], z, dt, noise=(2e-5, 2e-3), control=held_up, rng=rng)
        runs.append(replace(made, x=made.x + np.array([bias, 0.0])))
    return runs


LOSS, GAIN = 0.02, 0.5


class Room(System):
    """T' = gain heater - loss T: the temperature of a room above the one outside."""

    name = "room"
    state_names, state_units = ("T",), ("K",)
    input_names, input_units = ("heater",), ("kW",)
    ports = {Port("heat"): 1}
    residual_ports = {Port("heat"): ResidualPort(1, 0.1, "K/s")}
    defaults = Defaults(1.0, 20, (0.05,), 0.1, 1.0, "euler_maruyama")
    sensor_noise = True
    PARAMETERS = {"loss": Parameter(LOSS, "1/s", low=0.0), "gain": Parameter(GAIN, "K/(s kW)", low=0.0)}

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        heat = self.value("gain") * u - self.value("loss") * x
        return heat + forces.get(Port("heat"), 0.0)


def warmed(
    *,
    exchange: float = 0.0,
    time: float = 120.0,
    wall: float = 5.0,
    leak: float = 0.0,
    power: float = 0.5,
    weaker: float = 0.0,
) -> list[RawRun]:
    """Runs of a room whose wall takes heat up and gives it back, that loses heat with a power of it, and whose heater
    is weaker by a share in the second half of run 1.
    """

    def rates(x: Array, u: Array) -> list[float]:
        heat = GAIN * u[0] - LOSS * x[0] - leak * max(x[0], 0.0) ** power
        return [heat + exchange * (x[1] - x[0]), (x[0] - x[1]) / time]

    rng, out = np.random.default_rng(4), []
    for number in range(3):
        heater = held(rng, 0.0, 1.0, 900, each=30)
        acts = heater.copy()
        acts[450:] *= 1.0 - weaker * (number == 1)
        run = simulated(number, rates, [5.0, wall], acts, 1.0, noise=(0.02, 0.0), rng=rng, fine=2)
        out.append(replace(run, x=run.x[:, :1], u=heater))
    return out


STEP = 0.01


def pushed_spring(seed: int, seconds: float, push: Any) -> RawRun:
    """A spring that is pushed by u and `push(t, v, u, q)` [m/s2]."""
    rng = np.random.default_rng(seed)
    t = STEP * np.arange(round(seconds / STEP) + 1)
    f, phase = rng.uniform(0.1, 1.6, (4, 1)), rng.uniform(0.0, 2.0 * np.pi, (4, 1))
    u = 1.2 * np.sin(2.0 * np.pi * f * t + phase).sum(0)

    def rates(x: Array, u: Array) -> list[float]:
        (q, v), (force, now) = x, u
        return [v, force - 4.0 * q - 0.5 * v + push(now, v, force, q)]

    how = {"noise": (0.002, 0.01), "kick": (0.0, 0.0016), "rng": rng, "fine": 2}
    run = simulated(seed, rates, [0.2, 0.0], np.column_stack((u, t)), STEP, **how)
    return RawRun(run.name, t, run.x, u[:, None])


def behind_a_servo(hertz: float, ratio: float) -> list[RawRun]:
    """Runs of a spring (4 1/s2, damping 0.5 1/s) whose command is followed in second order."""
    rng, out, w, t = np.random.default_rng(9), [], 2.0 * np.pi * hertz, 0.02 * np.arange(750)

    def rates(x: Array, u: Array) -> list[float]:
        return [x[1], x[2] - 4.0 * x[0] - 0.5 * x[1], x[3], w * w * (u[0] - x[2]) - 2.0 * ratio * w * x[3]]

    for number in range(2):
        size, waves = rng.uniform(0.5, 2.0, 5), np.exp(rng.uniform(-2.3, 1.4, 5))
        u = np.sin(2.0 * np.pi * waves * t[:, None] + rng.uniform(0.0, 6.3, 5)) @ size
        start, noise = [*rng.uniform(-0.3, 0.3, 2), 0.0, 0.0], (0.001, 0.003, 0.0, 0.0)
        run = simulated(number, rates, start, u[:, None], 0.02, noise=noise, rng=rng)
        out.append(replace(run, x=run.x[:, :2]))
    return out
