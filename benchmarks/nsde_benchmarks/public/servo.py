"""A position-controlled servo that swings a pendulum, as BAM's test bench has it.

    (J + (m + a/3) l^2) theta'' = tau + sum of torques - (m + a/2) g l sin(theta - theta_0)
    tau = s (clip(k (goal - theta), -c, c) - e theta')         nothing while the servo is off

k [1/rad] is the gain of the servo's controller, set for each run; its duty cycle is limited to c. s is the stall torque
and e the speed constant of a direct-current motor behind its gears: s = k_t V / R, e = k_t / V. Mass m at the end of an
arm of length l and mass a are those of the run. Friction is not declared: the catalogue has it.
"""

from collections.abc import Mapping
from typing import final

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.effects import Coordinate, Parameter, Port
from nsde_torch.systems import Defaults, ResidualPort, System

GRAVITY = 9.80665
DUTY_LIMIT = 0.97
STEP = 0.005
INPUTS = ("goal", "gain", "enabled", "mass", "length")


@final
class ServoPendulum(System):
    """A pendulum on a servo. Motor, controller, weight and inertias are declared; the angle is 0 hanging."""

    name = "servo_pendulum"
    state_names = ("theta", "theta_dot")
    state_units = ("rad", "rad/s")
    input_names = INPUTS
    input_units = ("rad", "1/rad", "1", "kg", "m")
    position_derivatives = (("theta", "theta_dot", "world"),)
    sensor_noise = True
    ports = {Port.TORQUE: 1}
    quantities = {"gear_load": 1}
    coordinates = (
        Coordinate(
            "arm",
            "theta_dot",
            Port.TORQUE,
            "theta",
            kind="joint",
            unit="N m",
            words="the arm",
            load="gear_load",
        ),
    )
    residual_ports = {Port.TORQUE: ResidualPort(1, 0.1, "N m")}
    PARAMETERS = {
        "stall_torque": Parameter(5.0, "N m", low=0.0, help="torque at rest and a duty cycle of 1"),
        "speed_constant": Parameter(0.2, "s/rad", low=0.0, help="duty cycle that a speed takes"),
        "rotor_inertia": Parameter(0.01, "kg m2", low=0.0, scale=0.01, help="of motor and gears, at the arm"),
        "angle_offset": Parameter(0.0, "rad", scale=0.01, help="what the sensor reads of a hanging arm"),
    }
    defaults = Defaults(STEP, 50, (0.001, 0.05), 0.1, 1.0, "euler_maruyama")
    feature_names = ("sin_theta", "cos_theta", "theta_dot")
    feature_units = ("1", "1", "rad/s")

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        mass, length = u[:, 3:4], u[:, 4:5]
        inertia = (mass + _arm(length) / 3.0) * length * length + self.value("rotor_inertia")
        torque = self._motor(x, u) + self._weight(x, u)
        if Port.TORQUE in forces:
            torque = torque + forces[Port.TORQUE]
        return torch.cat((x[:, 1:], torque / inertia), 1)

    def quantity(self, name: str, x: Tensor, u: Tensor) -> Tensor:
        """What the gears carry between motor and arm (N, 1) [N m]: torque of the motor less that of the weight."""
        if name == "gear_load":
            return self._motor(x, u) - self._weight(x, u)
        return super().quantity(name, x, u)

    def features(self, x: Tensor) -> Tensor:
        """Sine and cosine of the angle, and the rate (N, 3)."""
        return torch.cat((torch.sin(x[:, :1]), torch.cos(x[:, :1]), x[:, 1:]), 1)

    def _motor(self, x: Tensor, u: Tensor) -> Tensor:
        duty = (u[:, 1:2] * (u[:, :1] - x[:, :1])).clamp(-DUTY_LIMIT, DUTY_LIMIT)
        return u[:, 2:3] * self.value("stall_torque") * (duty - self.value("speed_constant") * x[:, 1:])

    def _weight(self, x: Tensor, u: Tensor) -> Tensor:
        mass, length = u[:, 3:4], u[:, 4:5]
        turned = torch.sin(x[:, :1] - self.value("angle_offset"))
        return -(mass + 0.5 * _arm(length)) * GRAVITY * length * turned


def _arm(length: Tensor) -> Tensor:
    """Mass of the arm [kg], from the two that the set states: 36 g at 0.1 m, 50 g at 0.15 m."""
    return 0.008 + 0.28 * length


# The six friction models that BAM simulates a servo's pendulum with: a budget that may hold the arm at rest.
#
#     M1  c + b |v|                                              Coulomb and viscous
#     M2  M1 + s(v) c_s                    s(v) = exp(-|v / v_s|^alpha)                                         Stribeck
#     M3  M1 + k |tau_e - tau_m|                                                                        load-dependent
#     M4  M2 + (k + s(v) k_s) |tau_e - tau_m|
#     M5  M2 + |k_e tau_e - k_m tau_m| + s(v) |k_es tau_e - k_ms tau_m|                                    directional
#     M6  M5 + s(v) q tau^2 where the smaller of the two torques opposes the larger                          quadratic
#
# tau_m is the motor's torque, tau_e that of the weight. Friction takes what would stop the arm within a step,
# and no more than its budget. (Duclusaud, Passault, Padois, Ly, Extended friction models for the physics
# simulation of servo actuators, ICRA 2025.)


def budget(p: Mapping[str, float], motor: Array, weight: Array, speed: Array) -> Array:
    """Largest friction torque (N,) [N m]."""
    still = np.zeros_like(speed)
    if "dtheta_stribeck" in p:
        still = np.exp(-(np.abs(speed / p["dtheta_stribeck"]) ** p["alpha"]))
    out = p["friction_base"] + p["friction_viscous"] * np.abs(speed) + still * p.get("friction_stribeck", 0.0)
    if "load_friction_motor" in p:
        for extra, share in (("", np.ones_like(still)), ("_stribeck", still)):
            of_weight, of_motor = (p[f"load_friction_{side}{extra}"] for side in ("external", "motor"))
            out = out + share * np.abs(of_weight * weight - of_motor * motor)
    else:
        share = p.get("load_friction_base", 0.0) + still * p.get("load_friction_stribeck", 0.0)
        out = out + share * np.abs(weight - motor)
    if "load_friction_motor_quad" in p:
        opposed = np.sign(weight) != np.sign(motor)
        of_weight, of_motor = (p[f"load_friction_{side}_quad"] for side in ("external", "motor"))
        drives = np.abs(motor) > np.abs(weight)
        out = out + still * opposed * np.where(drives, of_weight * weight**2, of_motor * motor**2)
    result: Array = out
    return result


def swing(p: Mapping[str, float], x: Array, u: Array, volts: float) -> Array:
    """Angles (B, T + 1) [rad] of pendulums on a servo, by the steps of BAM."""
    angle, speed = x[:, 0].copy(), x[:, 1].copy()
    mass, length = u[:, 0, 3], u[:, 0, 4]
    inertia = mass * length**2 + p["armature"]  # as the set was fitted: without the mass of the arm
    out = np.empty((len(x), u.shape[1] + 1))
    out[:, 0] = angle
    for k in range(u.shape[1]):
        goal, gain, on = u[:, k, :3].T
        duty = np.clip(gain * (goal - angle), -DUTY_LIMIT, DUTY_LIMIT)
        motor = on * p["kt"] / p["R"] * (volts * duty - p["kt"] * speed)
        weight = -mass * GRAVITY * length * np.sin(angle + p["q_offset"])
        stops = inertia / STEP * speed + motor + weight
        friction = -np.sign(stops) * np.minimum(np.abs(stops), budget(p, motor, weight, speed))
        acceleration = (motor + weight + friction) / inertia
        speed = speed + STEP * acceleration
        angle = angle + STEP * speed + 0.5 * STEP**2 * acceleration
        out[:, k + 1] = angle
    return out
