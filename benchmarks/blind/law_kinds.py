"""Kinds of laws that no catalogue has, by machine: each with its text in the grammar of the package, to judge by.

States are those of the simulators: q, q' of a spring; x, x', theta, theta' of a cart; both angles and both rates of two
joints; of multirotors velocity and rates along the body's axes and the place, (v, w, p).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Term = Callable[[Array, Array, float], Array]
"""A term of unit size of states (n, nx), inputs (n, nu) and its shape, (n,)."""


@dataclass(frozen=True)
class Kind:
    """One kind of law.

    Args:
        system: Name of the machine.
        text: The law in the grammar of the package, to judge by.
        row: Which of the machine's forces it adds to.
        term: Its term, of unit size.
        shape: Quantile of a variable that its shape k1 is, or None.
        along: Which state that variable is.
    """

    system: str
    text: str
    row: int
    term: Term
    shape: float | None = None
    along: int = 0


SPRING = (
    Kind("mass_spring_damper", "force = c1 q q_dot", 0, lambda x, u, k: x[:, 0] * x[:, 1]),
    Kind("mass_spring_damper", "force = c1 q^2", 0, lambda x, u, k: x[:, 0] ** 2),
    Kind(
        "mass_spring_damper",
        "force = c1 max(q - k1, 0)",
        0,
        lambda x, u, k: np.maximum(x[:, 0] - k, 0.0),
        0.8,
    ),
    Kind("mass_spring_damper", "force = c1 q^5", 0, lambda x, u, k: x[:, 0] ** 5),
    Kind("mass_spring_damper", "force = c1 q^2 q_dot", 0, lambda x, u, k: x[:, 0] ** 2 * x[:, 1]),
    Kind("mass_spring_damper", "force = c1 q_dot^3", 0, lambda x, u, k: x[:, 1] ** 3),
    Kind("mass_spring_damper", "force = c1 q force", 0, lambda x, u, k: x[:, 0] * u[:, 0]),
    Kind(
        "mass_spring_damper", "force = c1 max(q_dot, 0)^2", 0, lambda x, u, k: np.maximum(x[:, 1], 0.0) ** 2
    ),
    Kind("mass_spring_damper", "force = c1 q q_dot^2", 0, lambda x, u, k: x[:, 0] * x[:, 1] ** 2),
)
CART = (
    Kind("cartpole", "force = c1 x_dot theta_dot", 0, lambda x, u, k: x[:, 1] * x[:, 3]),
    Kind("cartpole", "torque = c1 x_dot theta_dot", 1, lambda x, u, k: x[:, 1] * x[:, 3]),
    Kind("cartpole", "force = c1 x^2 x_dot", 0, lambda x, u, k: x[:, 0] ** 2 * x[:, 1]),
    Kind("cartpole", "torque = c1 sin(theta) x_dot", 1, lambda x, u, k: np.sin(x[:, 2]) * x[:, 1]),
    Kind("cartpole", "force = c1 max(x - k1, 0)", 0, lambda x, u, k: np.maximum(x[:, 0] - k, 0.0), 0.8),
    Kind("cartpole", "force = c1 sin(theta)", 0, lambda x, u, k: np.sin(x[:, 2])),
    Kind("cartpole", "torque = c1 x", 1, lambda x, u, k: x[:, 0]),
)
JOINTS = (
    Kind("joints", "torque[q1] = c1 q2_dot", 0, lambda x, u, k: x[:, 3]),
    Kind("joints", "torque[q2] = c1 q1_dot q2_dot", 1, lambda x, u, k: x[:, 2] * x[:, 3]),
    Kind("joints", "torque[q1] = c1 sin(q2)", 0, lambda x, u, k: np.sin(x[:, 1])),
    Kind("joints", "torque[q2] = c1 q1^2", 1, lambda x, u, k: x[:, 0] ** 2),
    Kind("joints", "torque[q1] = c1 q1_dot q2_dot", 0, lambda x, u, k: x[:, 2] * x[:, 3]),
    Kind("joints", "torque[q1] = c1 max(q1 - k1, 0)", 0, lambda x, u, k: np.maximum(x[:, 0] - k, 0.0), 0.8),
    Kind(
        "joints", "torque[q2] = c1 max(q2 - k1, 0)", 1, lambda x, u, k: np.maximum(x[:, 1] - k, 0.0), 0.8, 1
    ),
    Kind("joints", "torque[q2] = c1 q2^2 q2_dot", 1, lambda x, u, k: x[:, 1] ** 2 * x[:, 3]),
    Kind("joints", "torque[q1] = c1 sin(q2) q1_dot", 0, lambda x, u, k: np.sin(x[:, 1]) * x[:, 2]),
    Kind("joints", "torque[q2] = c1 q1 q2_dot", 1, lambda x, u, k: x[:, 0] * x[:, 3]),
    Kind("joints", "torque[q2] = c1 abs(q1_dot) q1_dot", 1, lambda x, u, k: np.abs(x[:, 2]) * x[:, 2]),
    Kind("joints", "torque[q1] = c1 q1^2 q1_dot", 0, lambda x, u, k: x[:, 0] ** 2 * x[:, 2]),
)


def _multirotor(system: str) -> tuple[Kind, ...]:
    return (
        Kind(system, "body_moment[y] = c1 v_body_x w_z", 4, lambda x, u, k: x[:, 0] * x[:, 5]),
        Kind(system, "body_force[z] = c1 v_body_x^2", 2, lambda x, u, k: x[:, 0] ** 2),
        Kind(system, "body_moment[z] = c1 v_body_x v_body_y", 5, lambda x, u, k: x[:, 0] * x[:, 1]),
        Kind(system, "body_force[y] = c1 v_body_x w_z", 1, lambda x, u, k: x[:, 0] * x[:, 5]),
        Kind(
            system, "body_moment[x] = c1 abs(v_body_y) v_body_y", 3, lambda x, u, k: np.abs(x[:, 1]) * x[:, 1]
        ),
    )


HEXACOPTER = _multirotor("hexacopter")
QUADROTOR = (
    *_multirotor("quadrotor"),
    Kind("quadrotor", "body_force[x] = c1 v_body_x v_body_z", 0, lambda x, u, k: x[:, 0] * x[:, 2]),
    Kind(
        "quadrotor", "body_force[z] = c1 abs(v_body_z) v_body_z", 2, lambda x, u, k: np.abs(x[:, 2]) * x[:, 2]
    ),
    Kind("quadrotor", "body_moment[y] = c1 v_body_x v_body_z", 4, lambda x, u, k: x[:, 0] * x[:, 2]),
    Kind(
        "quadrotor", "body_force[x] = c1 max(v_body_x, 0)^2", 0, lambda x, u, k: np.maximum(x[:, 0], 0.0) ** 2
    ),
    Kind("quadrotor", "body_force[z] = c1 p_x^2", 2, lambda x, u, k: x[:, 6] ** 2),
    Kind("quadrotor", "body_moment[z] = c1 v_body_y w_x", 5, lambda x, u, k: x[:, 1] * x[:, 3]),
)

ODD_SPRING = (
    Kind("mass_spring_damper", "a damping in one place", 0, lambda x, u, k: _near(x[:, 0], 0.3) * x[:, 1]),
    Kind(
        "mass_spring_damper", "a wave in the plane", 0, lambda x, u, k: np.sin(_in_plane(x)) * np.cos(x[:, 1])
    ),
    Kind(
        "mass_spring_damper",
        "a ridge",
        0,
        lambda x, u, k: np.tanh(2.0 * _in_plane(x)) ** 2 * np.tanh(2.0 * x[:, 0]),
    ),
    Kind("mass_spring_damper", "a gain in one place", 0, lambda x, u, k: _near(x[:, 0], -0.4) * u[:, 0]),
)
ODD_CART = (
    Kind("cartpole", "a damping in one place", 0, lambda x, u, k: _near(x[:, 0], 0.3) * x[:, 1]),
    Kind("cartpole", "a wave of place and speed", 0, lambda x, u, k: np.sin(2.0 * x[:, 0]) * np.cos(x[:, 1])),
    Kind("cartpole", "a torque in one place", 1, lambda x, u, k: _near(x[:, 0], -0.2) * np.sin(x[:, 2])),
)
"""Laws that the grammar of the package cannot write with few terms."""


def _near(v: Array, centre: float) -> Array:
    return np.exp(-(((v - centre) / 0.5) ** 2))


def _in_plane(x: Array) -> Array:
    return np.asarray(1.5 * x[:, 0] + 0.8 * x[:, 1])
