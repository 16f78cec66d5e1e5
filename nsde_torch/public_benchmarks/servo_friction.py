"""The six friction models that BAM simulates a servo's pendulum with: a budget that may hold the arm at rest.

    M1  c + b |v|                                              Coulomb and viscous
    M2  M1 + s(v) c_s                    s(v) = exp(-|v / v_s|^alpha)                                          Stribeck
    M3  M1 + k |tau_e - tau_m|                                                                        load-dependent
    M4  M2 + (k + s(v) k_s) |tau_e - tau_m|
    M5  M2 + |k_e tau_e - k_m tau_m| + s(v) |k_es tau_e - k_ms tau_m|                                    directional
    M6  M5 + s(v) q tau^2 where the smaller of the two torques opposes the larger                          quadratic

tau_m is the motor's torque, tau_e that of the weight. Friction takes what would stop the arm within a step, and no more
than its budget. (Duclusaud, Passault, Padois, Ly, Extended friction models for the physics simulation of servo
actuators, ICRA 2025.)
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.public_benchmarks.servo import DUTY_LIMIT, GRAVITY, STEP


def budget(p: Mapping[str, float], motor: Array, weight: Array, speed: Array) -> Array:
    """Largest friction torque (N,) [N m].

    Args:
        p: Parameters by the names that BAM gives them; those that a model lacks are left out.
        motor: Torque of the motor (N,) [N m].
        weight: Torque of the weight (N,) [N m].
        speed: Of the arm (N,) [rad/s].
    """
    still = np.zeros_like(speed)
    if "dtheta_stribeck" in p:
        still = np.exp(-(np.abs(speed / p["dtheta_stribeck"]) ** p["alpha"]))
    out = p["friction_base"] + p["friction_viscous"] * np.abs(speed) + still * p.get("friction_stribeck", 0.0)
    if "load_friction_motor" in p:
        for extra, share in (("", np.ones_like(still)), ("_stribeck", still)):
            of_weight, of_motor = (
                p[f"load_friction_{side}{extra}"] * torque
                for side, torque in (("external", weight), ("motor", motor))
            )
            out = out + share * np.abs(of_weight - of_motor)
    else:
        share = p.get("load_friction_base", 0.0) + still * p.get("load_friction_stribeck", 0.0)
        out = out + share * np.abs(weight - motor)
    if "load_friction_motor_quad" in p:
        opposed = np.sign(weight) != np.sign(motor)
        drives = np.abs(motor) > np.abs(weight)
        quadratic = np.where(
            drives, p["load_friction_external_quad"] * weight**2, p["load_friction_motor_quad"] * motor**2
        )
        out = out + still * opposed * quadratic
    result: Array = out
    return result


def swing(p: Mapping[str, float], x: Array, u: Array, volts: float) -> Array:
    """Angles (B, T + 1) [rad] of pendulums on a servo, by the steps of BAM.

    Args:
        p: Parameters `kt` [N m/A], `R` [ohm], `armature` [kg m2], `q_offset` [rad] and those of the friction.
        x: First states (B, 2).
        u: Goal, gain, whether the servo is on, mass and length (B, T, 5).
        volts: Supply [V].
    """
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
