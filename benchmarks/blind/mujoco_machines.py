"""Carts and quadrotors of MuJoCo, whose simulator nobody of this project wrote, with effects that nobody declared.

Needs `pip install mujoco`. Step 1 ms; the controller acts on what is logged (cart 50 Hz, quadrotor 100 Hz).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from study import Array, columns, save

STEP = 0.001  # [s]


@dataclass(frozen=True)
class Machine:
    """What a simulated machine has beyond the declared physics."""

    lag: float = 0.0  # time constant of the actuators [s]
    delay: int = 0  # of the inputs [steps]
    model: dict[str, str] = field(default_factory=dict)  # attributes of MuJoCo's elements, by element
    strength: Sequence[float] = (1.0, 1.0, 1.0, 1.0)  # of each motor


class CartOnRail:
    """A uniform pole of half-length 0.3 m and 0.25 kg that hangs from a cart of 0.9 kg, pushed by waves."""

    total, pole, half = 1.15, 0.25, 0.3
    inertia = 4.0 / 3.0 * pole * half**2  # about the pivot [kg m2]
    columns, dt, seconds = columns("cartpole"), 0.02, 30.0
    values: dict[str, float] = {"force_gain": 1.0 / total, "pole_share": pole / total, "half_length": half}

    def run(self, machine: Machine, rng: np.random.Generator) -> Array:
        """One run (T, 6)."""
        of = machine.model.get
        gravity = of("gravity", "0 0 -9.8")
        model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><option timestep="{STEP}" integrator="RK4" gravity="{gravity}"/>
            <worldbody><body><joint type="slide" axis="1 0 0" name="rail" {of("rail", "")}/>
            <geom type="box" size=".1 .05 .05" mass="0.9" contype="0" conaffinity="0"/>
            <body><joint type="hinge" axis="0 1 0" {of("pivot", "")}/>
            <geom type="box" size=".01 .01 .3" pos="0 0 .3" mass=".25" contype="0" conaffinity="0"/></body></body>
            </worldbody><actuator><motor joint="rail"/></actuator></mujoco>"""
        )
        across = self.pole * (2 * self.half) ** 2 / 12.0
        model.body_inertia[2] = [across, across, 1e-6]  # a thin rod
        data = mujoco.MjData(model)
        data.qpos[:] = [0.0, np.pi + 0.4 * rng.normal()]
        mujoco.mj_forward(model, data)
        size, frequency = rng.uniform(0.5, 1.6, 5), rng.uniform(0.3, 1.6, 5)
        phase = rng.uniform(0.0, 2.0 * np.pi, 5)
        queue, acting, gust = [0.0] * (machine.delay + 1), 0.0, 0.0
        rows = []
        for k in range(round(self.seconds / self.dt)):
            seen = np.array([data.qpos[0], data.qvel[0], data.qpos[1], data.qvel[1]])
            seen = seen + rng.normal(size=4) * [0.0005, 0.004, 0.001, 0.01]
            waves = size * np.sin(2.0 * np.pi * frequency * k * self.dt + phase)
            force = float(waves.sum() - 1.2 * seen[0] - 0.6 * seen[1])
            rows.append([k * self.dt, *seen, force])
            for _ in range(round(self.dt / STEP)):
                queue = [*queue[1:], force]
                acting, mean = _lagged(acting, queue[0], machine.lag)
                gust += -gust * STEP / 0.3 + 0.05 * rng.normal() * np.sqrt(2.0 * STEP / 0.3)
                data.ctrl[0], data.qfrc_applied[0] = mean, gust
                mujoco.mj_step(model, data)
        return np.array(rows)


class QuadrotorOnPath:
    """A quadrotor of 1.1 kg on paths of waves, by a cascade that sees what is logged."""

    mass, inertia, arm = 1.1, np.array([0.0105, 0.0121, 0.0197]), 0.17
    thrust, spin = 6.9, 0.016  # of a motor at full command [N], its moment about z over its thrust [m]
    columns, dt, seconds = columns("multirotor", 4), 0.01, 45.0
    places = ((arm, -arm), (-arm, arm), (arm, arm), (-arm, -arm))
    senses = (1.0, 1.0, -1.0, -1.0)  # of rotation, seen from above: the body is turned the other way
    values: dict[str, float] = {
        "thrust_gain": thrust / mass,
        "roll_gain": thrust * arm / 0.0105,
        "pitch_gain": thrust * arm / 0.0121,
        "yaw_gain": thrust * spin / 0.0197,
    }

    def run(self, machine: Machine, rng: np.random.Generator) -> Array:
        """One run (T, 18)."""
        model, of = self._model(machine), _Cascade(self, rng)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        hover = self.mass * 9.81 / (4.0 * self.thrust)
        acting, queue = np.full(4, hover), [np.full(4, hover)] * (machine.delay + 1)
        force, moment, rows = np.zeros(3), np.zeros(3), []
        strength = np.asarray(machine.strength)
        for k in range(round(self.seconds / self.dt)):
            turned, seen = np.empty(4), np.concatenate([[1.0], 0.0015 * rng.normal(size=3)])
            mujoco.mju_mulQuat(turned, data.qpos[3:7], seen / np.linalg.norm(seen))
            p = data.qpos[:3] + 0.002 * rng.normal(size=3)
            v = data.qvel[:3] + 0.01 * rng.normal(size=3)
            w = data.qvel[3:6] + 0.01 * rng.normal(size=3)
            command = of.command(k * self.dt, p, v, turned, w)
            rows.append([k * self.dt, *p, *v, *turned, *w, *command])
            for _ in range(round(self.dt / STEP)):
                queue = [*queue[1:], command]
                acting, mean = _lagged(acting, queue[0], machine.lag)
                force += -force * STEP / 0.6 + 0.12 * rng.normal(size=3) * np.sqrt(2.0 * STEP / 0.6)
                moment += -moment * STEP / 0.1 + 0.004 * rng.normal(size=3) * np.sqrt(2.0 * STEP / 0.1)
                data.ctrl[:] = mean * strength
                data.xfrc_applied[1, :3], data.xfrc_applied[1, 3:] = force, _matrix(data.qpos[3:7]) @ moment
                mujoco.mj_step(model, data)
        return np.array(rows)

    def _model(self, machine: Machine) -> Any:
        of = machine.model.get
        sites = "".join(f'<site name="m{i}" pos="{x} {y} 0"/>' for i, (x, y) in enumerate(self.places))
        motors = "".join(
            f'<general site="m{i}" gear="0 0 {self.thrust} 0 0 {-s * self.spin * self.thrust}"/>'
            for i, s in enumerate(self.senses)
        )
        inertia = " ".join(str(v) for v in self.inertia)
        return mujoco.MjModel.from_xml_string(
            f"""<mujoco><option timestep="{STEP}" integrator="RK4" gravity="0 0 -9.81" {of("air", "")}/>
            <worldbody><body pos="0 0 3"><freejoint/>
            <inertial pos="0 0 0" mass="{self.mass}" diaginertia="{inertia}"/>
            <geom type="ellipsoid" size=".16 .14 .05" mass="0" contype="0" conaffinity="0" {of("body", "")}/>{sites}
            </body></worldbody><actuator>{motors}</actuator></mujoco>"""
        )


class _Cascade:
    """Position, attitude and rate control along a path of waves."""

    def __init__(self, machine: QuadrotorOnPath, rng: np.random.Generator) -> None:
        self.machine = machine
        self.frequency, self.phase = rng.uniform(0.08, 0.45, (3, 3)), rng.uniform(0.0, 2.0 * np.pi, (3, 3))
        self.size = rng.uniform(0.3, 0.9, (3, 3)) * [[1.0], [1.0], [0.4]]
        self.yaw = rng.uniform(0.1, 0.3, 2), rng.uniform(0.0, 2.0 * np.pi, 2)
        x, y = np.array(machine.places).T
        turns = -machine.spin * np.array(machine.senses)
        self.from_moments = np.linalg.inv(np.stack([np.ones(4), y, -x, turns]))

    def command(self, t: float, p: Array, v: Array, q: Array, w: Array) -> Array:
        """Commands (4,)."""
        m, turn = self.machine, 2.0 * np.pi * self.frequency
        where = (self.size * np.sin(turn * t + self.phase)).sum(1) + np.array([0.0, 0.0, 3.0])
        speed = (self.size * turn * np.cos(turn * t + self.phase)).sum(1)
        wanted = 4.0 * (where - p) + 3.0 * (speed - v) + np.array([0.0, 0.0, 9.81])
        wanted = wanted * min(1.0, 18.0 / float(np.linalg.norm(wanted)))
        yaw = float(0.4 * np.sin(2.0 * np.pi * self.yaw[0] * t + self.yaw[1]).sum())
        up = wanted / np.linalg.norm(wanted)
        left = np.cross(up, [np.cos(yaw), np.sin(yaw), 0.0])
        left = left / np.linalg.norm(left)
        goal, now = np.stack([np.cross(left, up), left, up], 1), _matrix(q)
        off = 0.5 * (goal.T @ now - now.T @ goal)
        rates = -9.0 * np.array([off[2, 1], off[0, 2], 0.5 * off[1, 0]])
        moments = m.inertia * np.array([14.0, 14.0, 7.0]) * (rates - w)
        lift = m.mass * float(wanted @ now[:, 2])
        commands = self.from_moments @ np.array([lift, *moments]) / m.thrust
        return np.asarray(np.clip(commands, 0.02, 1.0))


def _lagged(acting: Any, wanted: Any, lag: float) -> tuple[Any, Any]:
    """What acts after one step, and its mean over the step."""
    left = np.exp(-STEP / lag) if lag else 0.0
    return wanted + (acting - wanted) * left, wanted + (acting - wanted) * (1.0 - left) * lag / STEP


def _matrix(q: Array) -> Array:
    out = np.empty(9)
    mujoco.mju_quat2Mat(out, np.asarray(q, dtype=np.float64))
    return out.reshape(3, 3)


Drawn = tuple[Machine, dict[str, dict[str, float]]]
Kind = Callable[[np.random.Generator], Drawn]
"""Draws a machine; the truth is effects with values of their parameters, where they are ours."""


def _joint(
    joint: str, over: float, attribute: str, low: float, high: float, effect: str, parameter: str
) -> Kind:
    """An attribute of a joint; as the package tells it, it is over the mass or the inertia."""

    def make(rng: np.random.Generator) -> Drawn:
        size = float(rng.uniform(low, high))
        return Machine(model={joint: f'{attribute}="{size}"'}), {effect: {parameter: size / over}}

    return make


_rail = partial(_joint, "rail", CartOnRail.total)
_pivot = partial(_joint, "pivot", CartOnRail.inertia)


def _slow(effect: str, low: float, high: float) -> Kind:
    def make(rng: np.random.Generator) -> Drawn:
        lag = float(rng.uniform(low, high))
        return Machine(lag=lag), {effect: {"time_constant": lag}}

    return make


def _late(low: int, high: int) -> Kind:
    def make(rng: np.random.Generator) -> Drawn:
        steps = int(rng.integers(low, high + 1))
        return Machine(delay=steps), {"input_delay": {"delay": steps * STEP}}

    return make


def _tilted(rng: np.random.Generator) -> Drawn:
    turn = float(rng.uniform(0.02, 0.06) * rng.choice([-1.0, 1.0]))
    gravity = f"{-9.8 * np.sin(turn)} 0 {-9.8 * np.cos(turn)}"
    return Machine(model={"gravity": gravity}), {"track_tilt": {"slope": float(np.tan(turn))}}


def _two(rng: np.random.Generator) -> Drawn:
    friction, lag = float(rng.uniform(0.15, 0.45)), float(rng.uniform(0.03, 0.08))
    truth = {"coulomb_friction[cart]": {"size": friction / CartOnRail.total}}
    truth["actuator_lag"] = {"time_constant": lag}
    return Machine(lag=lag, model={"rail": f'frictionloss="{friction}"'}), truth


def _weak(rng: np.random.Generator) -> Drawn:
    motor, left = int(rng.integers(4)), float(rng.uniform(0.8, 0.93))
    strength = [left if i == motor else 1.0 for i in range(4)]
    return Machine(strength=strength), {"motor_efficiency_loss": {f"loss[{motor}]": 1.0 - left}}


_IN_AIR = 'fluidshape="ellipsoid" fluidcoef="0.5 0.25 0.4 0 0"'


def _drag(rng: np.random.Generator) -> Drawn:
    air = f'density="{float(rng.uniform(2.0, 4.0))}"'
    return Machine(model={"air": air, "body": _IN_AIR}), {"quadratic_drag": {}}


KINDS: dict[str, tuple[type[CartOnRail] | type[QuadrotorOnPath], Kind]] = {
    "cart_nothing": (CartOnRail, lambda rng: (Machine(), {})),
    "cart_friction": (CartOnRail, _rail("frictionloss", 0.1, 0.5, "coulomb_friction[cart]", "size")),
    "cart_damping": (CartOnRail, _rail("damping", 0.1, 0.6, "viscous_friction[cart]", "damping")),
    "cart_spring": (CartOnRail, _rail("stiffness", 0.8, 4.0, "linear_spring[cart]", "stiffness")),
    "cart_lag": (CartOnRail, _slow("actuator_lag", 0.03, 0.1)),
    "cart_delay": (CartOnRail, _late(25, 80)),
    "cart_tilt": (CartOnRail, _tilted),
    "cart_two": (CartOnRail, _two),
    "pole_friction": (CartOnRail, _pivot("frictionloss", 0.003, 0.012, "coulomb_friction[pole]", "size")),
    "pole_damping": (CartOnRail, _pivot("damping", 0.002, 0.012, "viscous_friction[pole]", "damping")),
    "quadrotor_nothing": (QuadrotorOnPath, lambda rng: (Machine(), {})),
    "quadrotor_lag": (QuadrotorOnPath, _slow("motor_lag", 0.025, 0.06)),
    "quadrotor_delay": (QuadrotorOnPath, _late(15, 35)),
    "quadrotor_weak": (QuadrotorOnPath, _weak),
    "quadrotor_drag": (QuadrotorOnPath, _drag),
}


def write(kind: str, seed: int, folder: Path, runs: int = 3) -> dict[str, dict[str, float]]:
    """Write the runs of a machine as CSV files; returns its truth."""
    of, make = KINDS[kind]
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    machine, truth = make(rng)
    plant = of()
    for i in range(runs):
        save(folder / f"run_{i}.csv", plant.columns, [plant.run(machine, rng)])
    return truth
