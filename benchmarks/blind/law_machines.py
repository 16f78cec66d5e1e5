"""Machines with a law that no catalogue has: simulators of their own, in NumPy, that share no code with `nsde_torch`.

Springs and carts are those of `small_machines`, multirotors those of `loop_machine`, with a further force that is any
function of the true state; two joints are those of `examples/double_pendulum`. The size of a law is drawn as a share
of what moves the machine anyway.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import loop_flight
import numpy as np
import small_machines
from loop_machine import Bodies, Machine, rotation
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "examples" / "double_pendulum"))
import make_data

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
        shape: Quantile of the first variable that its shape k1 is, or None.
    """

    system: str
    text: str
    row: int
    term: Term
    shape: float | None = None


def column(k: int) -> Callable[[Array], Array]:
    """Column k of states."""
    return lambda x: x[:, k]


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
)
HEXACOPTER = (
    Kind("hexacopter", "body_moment[y] = c1 v_body_x w_z", 4, lambda x, u, k: x[:, 0] * x[:, 5]),
    Kind("hexacopter", "body_force[z] = c1 v_body_x^2", 2, lambda x, u, k: x[:, 0] ** 2),
    Kind("hexacopter", "body_moment[z] = c1 v_body_x v_body_y", 5, lambda x, u, k: x[:, 0] * x[:, 1]),
    Kind("hexacopter", "body_force[y] = c1 v_body_x w_z", 1, lambda x, u, k: x[:, 0] * x[:, 5]),
    Kind(
        "hexacopter",
        "body_moment[x] = c1 abs(v_body_y) v_body_y",
        3,
        lambda x, u, k: np.abs(x[:, 1]) * x[:, 1],
    ),
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


@dataclass(frozen=True)
class Law:
    """A law of a machine: kind, size and shape."""

    kind: Kind
    size: float
    shape: float = 0.0

    def __call__(self, x: Array, u: Array) -> Array:
        """What it adds (n,) at states (n, nx) and inputs (n, nu)."""
        return self.size * self.kind.term(x, u, self.shape)


def small_runs(
    system: str, law: Law | None, rng: np.random.Generator, seed: int, runs: int, seconds: float
) -> tuple[list[tuple[Array, Array, Array]], small_machines.Small]:
    """Runs of a spring or a cart with a law: times, measured states and forces."""
    machine = small_machines.small(system, rng, False)
    return [_small_run(machine, law, seconds, seed + r) for r in range(runs)], machine


def _small_run(
    machine: small_machines.Small, law: Law | None, seconds: float, seed: int
) -> tuple[Array, Array, Array]:
    plain, geometry = small_machines._rate, machine.values

    def rate(own: small_machines.Small, y: Array, u: float, white: Array) -> Array:
        if law is None:
            return plain(own, y, u, white)
        more = float(law(y[None], np.array([[u]]))[0])
        if own.system == "mass_spring_damper" or law.kind.row == 0:
            return plain(own, y, u, white + np.array([more, 0.0]))
        inertia = 4 / 3 - geometry["s"] * np.cos(y[2]) ** 2
        return plain(own, y, u, white + np.array([0.0, 4.0 / 3.0 * more / inertia]))

    small_machines._rate = rate
    try:
        return small_machines.run(machine, seconds, 0.01 if machine.system != "cartpole" else 0.02, seed)
    finally:
        small_machines._rate = plain


class LawBodies(Bodies):
    """A batch of multirotors, each with the law that its machine's `effects` hold under `law`."""

    def __init__(self, machines: list[Machine], t0: Array, noise: object = None, step: float = 0.001) -> None:
        super().__init__(machines, t0, noise, step)
        self.laws = [m.effects.get("law", {}).get("of") for m in machines]

    def rates(
        self, p: Array, v: Array, q: Array, w: Array, m: Array, t: Array, push: Array
    ) -> tuple[Array, Array, Array, Array]:
        """See `Bodies.rates`."""
        r = rotation(q)
        seen = np.concatenate([np.einsum("bji,bj->bi", r, v), w], 1)
        pushed = push.copy()
        for b, law in enumerate(self.laws):
            if law is None:
                continue
            more = float(law(seen[b : b + 1], m[b : b + 1])[0])
            if law.kind.row < 3:
                pushed[b, :3] += r[b][:, law.kind.row] * more
            else:
                pushed[b, law.kind.row] += more
        return super().rates(p, v, q, w, m, t, pushed)


def flights(machine: Machine, seed: int, runs: int, seconds: float) -> list[loop_flight.Logged]:
    """Flights of a machine whose `effects` may hold a law."""
    rng = np.random.default_rng([seed, 9])
    paths = [loop_flight.PATHS[i % 3] for i in range(runs)]
    asked = [
        loop_flight.Flight(machine, path, "a", seconds, 0.0, int(rng.integers(2**31)), 1.0, 1.2)
        for path in paths
    ]
    plain, loop_flight.Bodies = loop_flight.Bodies, LawBodies
    try:
        return loop_flight.fly(asked)
    finally:
        loop_flight.Bodies = plain


def joint_push(law: Law | None) -> make_data.Push:
    """The torques of a law on two joints."""

    def push(q: Array, w: Array) -> Array:
        out = np.zeros(2)
        if law is not None:
            out[law.kind.row] = law(np.concatenate([q, w])[None], np.zeros((1, 2)))[0]
        return out

    return push
