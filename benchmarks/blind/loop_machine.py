"""Multirotors of the closed-loop cases: a rigid body of its own, in NumPy, that shares no code with `nsde_torch`.

    p' = v,   v' = R(q) F + (0, 0, -g) + world force + gust,       F = (0, 0, T) + what a case holds, over mass
    q' = q (0, omega) / 2
    omega' = J^-1 (D a - omega x J omega) + what a case holds + gust,    a = gains * (signs^T s),  D = diag(J)
    T = k sum_i s_i + c,   s_i: command i after delay, lag and change of strength

by Runge-Kutta 4 at a millisecond, commands held over it and a lag exact. World ENU, body FLU, q = (w, x, y, z) body to
world. Effects are those that `nsde effects system=hexacopter` prints, written again from the formulas there; products
of inertia are exact here. Everything is batched: row b is one flight of one machine.

Gusts are world forces with the spectrum of Dryden's transverse turbulence (MIL-F-8785C), and moments behind two equal
low-pass filters:

    force: (1 + sqrt(3) T s) / (1 + T s)^2,        moment: 1 / (1 + T s)^2          of white noise
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

G = 9.81
STEP = 0.001
"""Step of the integration [s]."""
MOTORS = 6
SIGNS: dict[str, Array] = {  # roll, pitch, yaw of each motor (PX4's numbers)
    "hexacopter": np.array(
        [[-1, 1, 0.5, -0.5, -0.5, 0.5], np.sqrt(0.75) * np.array([0, 0, -1, 1, -1, 1]), [1, -1, 1, -1, -1, 1]]
    ),
    "quadrotor": np.array([[-1, 1, 1, -1], [-1, 1, -1, 1], [-1, -1, 1, 1]], dtype=float),
}
SIZES: dict[str, dict[str, int]] = {
    **{name: {"drag": 3} for name in ("linear_drag", "quadratic_drag", "rotor_drag")},
    **{"translational_lift": {"lift": 1}, "constant_wind": {"drag": 3, "wind": 2}},
    **{"constant_world_force": {"acceleration": 3}, "ground_effect": {"area": 1, "height": 1}},
    **{"thrust_misalignment": {"tilt": 2}, "angular_damping": {"damping": 3}, "com_offset": {"offset": 2}},
    **{"gyroscopic_moment": {"momentum": 2}, "flapping_moment": {"gain": 2}},
    **{"inertia_coupling": {"product": 3}, "motor_lag": {"time_constant": 1}, "input_delay": {"delay": 1}},
    **{"motor_efficiency_loss": {"loss": MOTORS}, "thrust_sag": {"rate": 1}},
    **{"battery_voltage": {"sensitivity": 1}, "thrust_curve": {"curvature": 1}},
}
"""Effects and the sizes of their parameters; zeros are no effect."""
Effects = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Machine:
    system: str  # `hexacopter` or `quadrotor`
    thrust_gain: float  # thrust over mass per unit of summed command [m/s2]
    thrust_offset: float  # the same at no command [m/s2]
    gains: tuple[float, float, float]  # roll, pitch, yaw acceleration per unit of signed command [rad/s2]
    inertia: tuple[float, float]  # Jx / Jz and Jy / Jz
    effects: Effects = field(default_factory=dict)  # what it holds beside, name -> parameter -> value
    gust: tuple[float, ...] = (0.0,) * 6  # standard deviations of world force [m/s2] and moment [rad/s2]
    gust_time: tuple[float, float] = (0.5, 0.1)  # time constants of the two filters [s]

    @property
    def declared(self) -> dict[str, float]:
        """Its parameters by the names of the package."""
        names = [
            "thrust_gain",
            "thrust_offset",
            "roll_gain",
            "pitch_gain",
            "yaw_gain",
            "inertia_x",
            "inertia_y",
        ]
        values = (self.thrust_gain, self.thrust_offset, *self.gains, *self.inertia)
        return dict(zip(names, values, strict=True))

    @property
    def hover(self) -> float:
        return (G - self.thrust_offset) / (self.thrust_gain * SIGNS[self.system].shape[1])


def rotation(q: Array) -> Array:
    """Matrices (B, 3, 3) from body to world of unit quaternions (B, 4)."""
    w, x, y, z = q.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.moveaxis(np.array(rows), 2, 0)


def product(a: Array, b: Array) -> Array:
    """Hamilton product of quaternions (B, 4)."""
    a0, av, b0, bv = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    vector = a0 * bv + b0 * av + cross(av, bv)
    return np.concatenate([a0 * b0 - (av * bv).sum(1, keepdims=True), vector], axis=1)


def cross(a: Array, b: Array) -> Array:
    """Cross product of rows (B, 3); np.cross takes ten times as long."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for k, i, j in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[:, k] = a[:, i] * b[:, j] - a[:, j] * b[:, i]
    return out


def times(m: Array, v: Array) -> Array:
    """Matrices (B, 3, 3) times vectors (B, 3)."""
    return np.einsum("bij,bj->bi", m, v)


class Bodies:
    """A batch of machines in flight, one for each row.

    `t0` is the clock at the start (B,) [s], which thrust that falls with time reads; `noise` makes white noise of the
    gusts (B, 6). True states are p, v, q, w, (B, 3), (B, 3), (B, 4), (B, 3), and lagged commands m (B, 6).
    """

    def __init__(self, machines: list[Machine], t0: Array, noise: Any = None, step: float = STEP) -> None:
        n = len(machines)
        self.step, self.t, self._noise = step, np.asarray(t0, dtype=float), noise
        self.signs = np.zeros((n, 3, MOTORS))
        self.there = np.zeros((n, MOTORS))
        for b, machine in enumerate(machines):
            signs = SIGNS[machine.system]
            self.signs[b, :, : signs.shape[1]], self.there[b, : signs.shape[1]] = signs, 1.0
        self.thrust_gain = np.array([m.thrust_gain for m in machines])
        self.thrust_offset = np.array([m.thrust_offset for m in machines])
        self.gains = np.array([m.gains for m in machines])
        self.e = {
            name: {k: _rows(machines, name, k, size) for k, size in sizes.items()}
            for name, sizes in SIZES.items()
        }
        self.diagonal = np.array([[*m.inertia, 1.0] for m in machines])
        self.inertia = np.zeros((n, 3, 3))
        for i in range(3):
            self.inertia[:, i, i] = self.diagonal[:, i]
        for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
            self.inertia[:, i, j] = self.inertia[:, j, i] = self.e["inertia_coupling"]["product"][:, k]
        self.inverse = np.linalg.inv(self.inertia)
        self.tau = self.e["motor_lag"]["time_constant"]
        self.drag = self.e["linear_drag"]["drag"] + self.e["constant_wind"]["drag"]
        self.wind = np.concatenate([self.e["constant_wind"]["wind"], np.zeros((n, 1))], 1)
        self.late = np.round(self.e["input_delay"]["delay"][:, 0] / step).astype(int)
        hover = np.array([m.hover for m in machines])[:, None] * self.there
        self.past = np.repeat(hover[None], self.late.max() + 1, axis=0)
        self._at = 0
        self.p, self.v, self.w = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
        self.q = np.tile([1.0, 0, 0, 0], (n, 1))
        self.m, self.voltage = hover.copy(), np.full(n, 16.0)
        self._gust_std = np.array([m.gust for m in machines])
        self._keep = np.exp(-step / np.repeat(np.array([m.gust_time for m in machines]), 3, axis=1))
        self._a = self._b = np.zeros((n, 6))
        if noise is not None:  # from their stationary law: var a = 1, var b = cov(a, b) = 1 / 2
            self._a = noise()
            self._b = 0.5 * self._a + 0.5 * noise()

    def gust(self) -> Array:
        """World force and moment over mass and inertia (B, 6), a step further."""
        if self._noise is None:
            return np.zeros((len(self.p), 6))
        keep = self._keep
        self._b = keep * self._b + (1 - keep) * self._a
        self._a = keep * self._a + np.sqrt(1 - keep**2) * self._noise()
        root = np.sqrt(3.0)
        shaped = np.sqrt(2.0) * self._b
        shaped[:, :3] = (root * self._a[:, :3] + (1 - root) * self._b[:, :3]) / np.sqrt(2.0)
        return self._gust_std * shaped

    def advance(self, u: Array) -> None:
        """One step under commands (B, 6) in [0, 1]."""
        h, push = self.step, self.gust()
        self.past[self._at] = u
        rows = np.arange(len(u))
        acting = self.past[(self._at - self.late) % len(self.past), rows]
        self._at = (self._at + 1) % len(self.past)
        lagged = [self._lagged(acting, share * h) for share in (0.0, 0.5, 1.0)]
        y = (self.p, self.v, self.q, self.w)
        k1 = self.rates(*y, lagged[0], self.t, push)
        k2 = self.rates(*_along(y, k1, 0.5 * h), lagged[1], self.t + 0.5 * h, push)
        k3 = self.rates(*_along(y, k2, 0.5 * h), lagged[1], self.t + 0.5 * h, push)
        k4 = self.rates(*_along(y, k3, h), lagged[2], self.t + h, push)
        self.p, self.v, self.q, self.w = (
            a + (h / 6) * (b + 2 * c + 2 * d + e) for a, b, c, d, e in zip(y, k1, k2, k3, k4, strict=True)
        )
        self.q = self.q / np.linalg.norm(self.q, axis=1, keepdims=True)
        self.m, self.t = lagged[2], self.t + h

    def _lagged(self, u: Array, time: float) -> Array:
        """Commands behind the lag after a time under constant ones."""
        stays = np.exp(-time / np.maximum(self.tau, 1e-9)) if time else np.where(self.tau > 0, 1.0, 0.0)
        return u + stays * (self.m - u)

    def rates(
        self, p: Array, v: Array, q: Array, w: Array, m: Array, t: Array, push: Array
    ) -> tuple[Array, Array, Array, Array]:
        e = self.e
        strength = 1 - e["motor_efficiency_loss"]["loss"] - e["thrust_sag"]["rate"] * t[:, None]
        strength = strength + e["battery_voltage"]["sensitivity"] * (self.voltage - 16.0)[:, None]
        s = (strength * m + e["thrust_curve"]["curvature"] * m * m) * self.there
        thrust = self.thrust_gain * s.sum(1) + self.thrust_offset
        r = rotation(q)
        air = np.einsum("bji,bj->bi", r, v - self.wind)
        still = np.einsum("bji,bj->bi", r, v)
        speed = np.linalg.norm(v, axis=1, keepdims=True)
        force = -self.drag * air - e["quadratic_drag"]["drag"] * speed * still
        spun = np.sqrt(np.maximum(thrust, 0.0) / G)[:, None]  # rotor speed over that of hover
        force -= e["rotor_drag"]["drag"] * spun * still
        force[:, 2] += e["translational_lift"]["lift"][:, 0] * np.square(still[:, :2]).sum(1)
        force[:, :2] += e["thrust_misalignment"]["tilt"] * thrust[:, None]
        near = e["ground_effect"]["area"] / (p[:, 2:] ** 2 + e["ground_effect"]["height"] ** 2 + 1e-12)
        force[:, 2] += thrust * (1 + near[:, 0])
        acceleration = times(r, force) + e["constant_world_force"]["acceleration"] + push[:, :3]
        acceleration[:, 2] -= G
        own = self.gains * times(self.signs, s)
        turning = times(self.inverse, self.diagonal * own - cross(w, times(self.inertia, w)))
        turning = turning + push[:, 3:] - e["angular_damping"]["damping"] * w
        offset, flap = e["com_offset"]["offset"], e["flapping_moment"]["gain"]
        spun = (self.signs[:, 2] * np.sqrt(np.maximum(s, 0.0))).sum(1)[:, None]
        spin = e["gyroscopic_moment"]["momentum"] * spun
        turning[:, 0] += -offset[:, 1] * thrust + flap[:, 0] * still[:, 1] + spin[:, 0] * w[:, 1]
        turning[:, 1] += offset[:, 0] * thrust - flap[:, 1] * still[:, 0] - spin[:, 1] * w[:, 0]
        half = 0.5 * product(q, np.concatenate([np.zeros((len(w), 1)), w], 1))
        return v, acceleration, half, turning


def _rows(machines: list[Machine], name: str, parameter: str, size: int) -> Array:
    """A parameter of an effect for each row (B, size); zero where a machine does not hold the effect."""
    out = np.zeros((len(machines), size))
    for b, machine in enumerate(machines):
        if name in machine.effects:
            values = np.atleast_1d(machine.effects[name][parameter])
            out[b, : len(values)] = values
    return out


def _along(y: tuple[Array, ...], k: tuple[Array, ...], h: float) -> tuple[Array, ...]:
    return tuple(a + h * b for a, b in zip(y, k, strict=True))
