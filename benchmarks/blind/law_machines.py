"""Machines with a law that no catalogue has: simulators of their own, in NumPy, that share no code with `nsde_torch`.

Springs and carts are those of `small_machines`, multirotors those of `loop_machine`, with a further force that is any
function of the true state; two joints are those of `examples/double_pendulum`. States of multirotors are here velocity
and rates along the body's axes, and the place. The size of a law is drawn as a share of what moves the machine anyway.
"""

import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import loop_flight
import numpy as np
import small_machines
from loop_machine import Bodies, Machine, rotation
from study import STATES, Array

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "examples" / "double_pendulum"))
import make_data

Term = Callable[[Array, Array, float], Array]
"""A term of unit size of states (n, nx), inputs (n, nu) and its shape, (n,)."""
JOINTS = "double_pendulum:DoublePendulum"
SYSTEMS = {
    **dict.fromkeys(("spring", "odd_spring"), "mass_spring_damper"),
    **dict.fromkeys(("cart", "odd_cart"), "cartpole"),
    **{"joints": JOINTS, "hexacopter": "hexacopter", "quadrotor": "quadrotor"},
}
_FLYING = ("v_body_x", "v_body_y", "v_body_z", "w_x", "w_y", "w_z", "p_x", "p_y", "p_z")
VARIABLES = {
    **STATES,
    **{JOINTS: ("q1", "q2", "q1_dot", "q2_dot"), "hexacopter": _FLYING, "quadrotor": _FLYING},
}
ROWS = {
    **{"force": 0, "torque": 1, "torque[q1]": 0, "torque[q2]": 1},
    **{f"body_force[{axis}]": i for i, axis in enumerate("xyz")},
    **{f"body_moment[{axis}]": 3 + i for i, axis in enumerate("xyz")},
}
"""Which of the machine's forces a law adds to."""
_MULTIROTOR = (
    "body_moment[y] = c1 v_body_x w_z",
    "body_force[z] = c1 v_body_x^2",
    "body_moment[z] = c1 v_body_x v_body_y",
    "body_force[y] = c1 v_body_x w_z",
    "body_moment[x] = c1 abs(v_body_y) v_body_y",
)
TEXTS = {
    "spring": (
        "force = c1 q q_dot",
        "force = c1 q^2",
        "force = c1 max(q - k1, 0)",
        "force = c1 q^5",
        "force = c1 q^2 q_dot",
        "force = c1 q_dot^3",
        "force = c1 q force",
        "force = c1 max(q_dot, 0)^2",
        "force = c1 q q_dot^2",
    ),
    "cart": (
        "force = c1 x_dot theta_dot",
        "torque = c1 x_dot theta_dot",
        "force = c1 x^2 x_dot",
        "torque = c1 sin(theta) x_dot",
        "force = c1 max(x - k1, 0)",
        "force = c1 sin(theta)",
        "torque = c1 x",
    ),
    "joints": (
        "torque[q1] = c1 q2_dot",
        "torque[q2] = c1 q1_dot q2_dot",
        "torque[q1] = c1 sin(q2)",
        "torque[q2] = c1 q1^2",
        "torque[q1] = c1 q1_dot q2_dot",
        "torque[q1] = c1 max(q1 - k1, 0)",
        "torque[q2] = c1 max(q2 - k1, 0)",
        "torque[q2] = c1 q2^2 q2_dot",
        "torque[q1] = c1 sin(q2) q1_dot",
        "torque[q2] = c1 q1 q2_dot",
        "torque[q2] = c1 abs(q1_dot) q1_dot",
        "torque[q1] = c1 q1^2 q1_dot",
    ),
    "hexacopter": _MULTIROTOR,
    "quadrotor": (
        *_MULTIROTOR,
        "body_force[x] = c1 v_body_x v_body_z",
        "body_force[z] = c1 abs(v_body_z) v_body_z",
        "body_moment[y] = c1 v_body_x v_body_z",
        "body_force[x] = c1 max(v_body_x, 0)^2",
        "body_force[z] = c1 p_x^2",
        "body_moment[z] = c1 v_body_y w_x",
    ),
}
"""Laws in the grammar of the package, to judge by; they are worked out here by NumPy."""


class Kind(NamedTuple):
    system: str  # name of the machine
    text: str  # the law in the grammar of the package
    row: int  # which of the machine's forces it adds to
    term: Term  # its term, of unit size
    shape: float | None = None  # quantile of a variable that its shape k1 is, or None
    along: int = 0  # which state that variable is


def _term(text: str, system: str) -> Term:
    """The term of a law: powers, products of what stands side by side, and functions of NumPy."""
    product = re.sub(r"(?<![-,]) (?![-,0k])", " * ", text.partition(" = c1 ")[2]).replace("^", "**")
    code = compile(product, text, "eval")
    functions = {"sin": np.sin, "abs": np.abs, "max": np.maximum}

    def term(x: Array, u: Array, k: float) -> Array:
        known = {**functions, **dict(zip(VARIABLES[system], x.T, strict=False)), "force": u[:, 0], "k1": k}
        return np.asarray(eval(code, {}, known))

    return term


def _kind(text: str, system: str) -> Kind:
    hinge = re.search(r"(\w+) - k1", text)
    shape = (0.8, VARIABLES[system].index(hinge[1])) if hinge else (None, 0)
    return Kind(system, text, ROWS[text.partition(" = ")[0]], _term(text, system), *shape)


def _near(v: Array, centre: float) -> Array:
    return np.exp(-(((v - centre) / 0.5) ** 2))


def _in_plane(x: Array) -> Array:
    return np.asarray(1.5 * x[:, 0] + 0.8 * x[:, 1])


ODD: dict[str, tuple[tuple[str, int, Term], ...]] = {
    "odd_spring": (
        ("a damping in one place", 0, lambda x, u, k: _near(x[:, 0], 0.3) * x[:, 1]),
        ("a wave in the plane", 0, lambda x, u, k: np.sin(_in_plane(x)) * np.cos(x[:, 1])),
        ("a ridge", 0, lambda x, u, k: np.tanh(2.0 * _in_plane(x)) ** 2 * np.tanh(2.0 * x[:, 0])),
        ("a gain in one place", 0, lambda x, u, k: _near(x[:, 0], -0.4) * u[:, 0]),
    ),
    "odd_cart": (
        ("a damping in one place", 0, lambda x, u, k: _near(x[:, 0], 0.3) * x[:, 1]),
        ("a wave of place and speed", 0, lambda x, u, k: np.sin(2.0 * x[:, 0]) * np.cos(x[:, 1])),
        ("a torque in one place", 1, lambda x, u, k: _near(x[:, 0], -0.2) * np.sin(x[:, 2])),
    ),
}
"""Laws that the grammar of the package cannot write with few terms."""
KINDS = {name: [_kind(text, SYSTEMS[name]) for text in texts] for name, texts in TEXTS.items()}
KINDS |= {name: [Kind(SYSTEMS[name], *law) for law in odd] for name, odd in ODD.items()}


class Law(NamedTuple):
    """A law of a machine: kind, size and shape."""

    kind: Kind
    size: float
    shape: float = 0.0

    def __call__(self, x: Array, u: Array) -> Array:
        """What it adds (n,) at states (n, nx) and inputs (n, nu)."""
        return self.size * self.kind.term(x, u, self.shape)


def small_runs(
    system: str, law: Law | None, rng: np.random.Generator, seed: int, runs: int, seconds: float
) -> list[tuple[Array, Array, Array]]:
    """Runs of a spring or a cart with a law: times, measured states and forces."""
    machine = small_machines.small(system, rng, False)
    share = machine.values.get("s", 0.0)

    def acts(y: Sequence[float], u: float) -> tuple[float, float]:
        more = float(law(np.array([y]), np.array([[u]]))[0])
        if law.kind.row == 0:
            return more, 0.0
        return 0.0, 4.0 / 3.0 * more / (4 / 3 - share * np.cos(y[2]) ** 2)

    machine = machine if law is None else replace(machine, law=acts)
    dt = 0.02 if system == "cartpole" else 0.01
    return [small_machines.run(machine, seconds, dt, seed + r) for r in range(runs)]


class LawBodies(Bodies):
    """A batch of multirotors, each with the law that its machine's `effects` hold under `law`."""

    def __init__(self, machines: list[Machine], *how: Any) -> None:
        super().__init__(machines, *how)
        self.laws = [m.effects.get("law", {}).get("of") for m in machines]

    def rates(self, p: Array, v: Array, q: Array, w: Array, m: Array, t: Array, push: Array) -> Any:
        r, pushed = rotation(q), push.copy()
        seen = np.concatenate([np.einsum("bji,bj->bi", r, v), w, p], 1)
        for b, law in enumerate(self.laws):
            if law is not None:
                more = float(law(seen[b : b + 1], m[b : b + 1])[0])
                row = law.kind.row
                pushed[b] += np.r_[r[b][:, row], 0, 0, 0] * more if row < 3 else more * (np.arange(6) == row)
        return super().rates(p, v, q, w, m, t, pushed)


def flights(
    machine: Machine, seed: int, seconds: float, paths: tuple[str, ...], noise: float = 1.0
) -> list[loop_flight.Logged]:
    """Flights of a machine whose `effects` may hold a law, one for each path."""
    rng = np.random.default_rng([seed, 9])
    asked = [
        loop_flight.Flight(machine, path, "a", seconds, 0.0, int(rng.integers(2**31)), noise, 1.2)
        for path in paths
    ]
    return loop_flight.fly(asked, LawBodies)


def joint_push(law: Law | None) -> make_data.Push:
    def push(q: Array, w: Array) -> Array:
        out = np.zeros(2)
        if law is not None:
            out[law.kind.row] = law(np.concatenate([q, w])[None], np.zeros((1, 2)))[0]
        return out

    return push
