"""Springs and carts in plain Python, which share no code with `nsde_torch`, and what encoders and users make of them.

    spring    q'' = -k q - b v + g u + what a case holds                                 (over mass)
    cart      a = g u + s l w^2 sin(theta) + what a case holds,   s = m / M
              w' = (G sin(theta) - a cos(theta)) / (l (4/3 - s cos(theta)^2)),   x'' = a - s l w' cos(theta)
              (Barto, Sutton and Anderson, IEEE Transactions on Systems, Man, and Cybernetics 13 (1983))

by Runge-Kutta 4 at a fraction of the log's step, inputs held over a row; gusts are white. Runs of a `Small` have a
force of sines and steps, and that of the cart also holds it near the middle by what the log measures; those of `spring`
and `cart` have sums of sines.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import cos, pi, sin, sqrt, tanh
from typing import Any

import numpy as np
from scipy.signal import butter, lfilter, savgol_filter
from study import Array

G = 9.8
Law = Callable[[float, float], float]
"""A force over mass, of position and speed."""
RATES = ("none", "gradient", "backward", "savgol", "butterworth")
EFFECTS: dict[str, Callable[[float, float, float], float]] = {
    "coulomb": lambda size, q, v: -size * tanh(v / 0.01),
    "quadratic": lambda size, q, v: -size * abs(v) * v,
    "hardening": lambda size, q, v: -size * q**3,
    "damping_by_place": lambda size, q, v: -size * q * q * v,
    "slope": lambda size, q, v: -size * sin(2.0 * q),
}
"""Forces of their size, the position and the speed."""


def rate(
    system: str, p: dict[str, float], y: Sequence[float], u: float, own: float, torque: float
) -> list[float]:
    """Derivatives of the states under an input, a force and an angular acceleration."""
    if system == "mass_spring_damper":
        return [y[1], -p["k"] * y[0] - p["b"] * y[1] + p["g"] * u + own]
    s, c, w = sin(y[2]), cos(y[2]), y[3]
    a = p["g"] * u + p["s"] * p["l"] * w * w * s + own
    turn = (G * s - a * c) / (p["l"] * (4 / 3 - p["s"] * c * c)) + torque
    return [y[1], a - p["s"] * p["l"] * turn * c, w, turn]


def step(rates: Callable[[Sequence[Any]], Sequence[Any]], y: Sequence[Any], h: float) -> list[Any]:
    """One step of Runge and Kutta; states are numbers, or rows of them."""
    k1 = rates(y)
    k2 = rates([a + 0.5 * h * b for a, b in zip(y, k1, strict=True)])
    k3 = rates([a + 0.5 * h * b for a, b in zip(y, k2, strict=True)])
    k4 = rates([a + h * b for a, b in zip(y, k3, strict=True)])
    return [a + h / 6 * (b + 2 * c + 2 * d + e) for a, b, c, d, e in zip(y, k1, k2, k3, k4, strict=True)]


@dataclass(frozen=True)
class Small:
    system: str  # `mass_spring_damper` or `cartpole`
    values: dict[str, float]  # its parameters by the names above
    effects: dict[str, dict[str, Any]] = field(default_factory=dict)  # sizes of `EFFECTS` that it holds
    noise: tuple[float, ...] = ()  # standard deviations of its sensors
    gust: float = 0.02  # white force and angular acceleration, by the root of a second [m/s1.5]
    steady: float = 0.0  # a force that never changes [m/s2]
    wave: tuple[float, float, float] = (0.0, 0.0, 0.0)  # size [m/s2], frequency [Hz] and phase of a force
    law: Callable[[Sequence[float], float], tuple[float, float]] = lambda y, u: (0.0, 0.0)
    """A further force and angular acceleration, of states and input."""

    def rate(self, y: Sequence[float], u: float, white: Array) -> list[float]:
        force, torque = self.law(y, u)
        own = sum(EFFECTS[name](e["size"], y[0], y[1]) for name, e in self.effects.items())
        return rate(self.system, self.values, y, u, white[0] + self.steady + own + force, white[1] + torque)


def small(system: str, rng: np.random.Generator, effect: bool) -> Small:
    """A machine with random parameters; with one effect of random size, or none."""
    level = float(rng.uniform(0.5, 1.5))
    if system == "mass_spring_damper":
        values = {"k": rng.uniform(0.6, 8.0), "b": rng.uniform(0.2, 1.0), "g": rng.uniform(0.5, 2.0)}
        noise, names = (0.004, 0.01), ("coulomb", "quadratic", "hardening")
    else:
        values = {"g": rng.uniform(0.6, 1.3), "s": rng.uniform(0.06, 0.25), "l": rng.uniform(0.25, 0.7)}
        noise, names = (0.004, 0.01, 0.01, 0.03), ("coulomb", "quadratic")
    held = {}
    if effect:
        held = {str(rng.choice(names)): {"size": float(np.exp(rng.uniform(np.log(0.08), np.log(0.4))))}}
    return Small(system, {k: float(v) for k, v in values.items()}, held, tuple(level * n for n in noise))


def run(
    machine: Small, seconds: float, dt: float, seed: int, then: Small | None = None, moment: float = np.inf
) -> tuple[Array, Array, Array]:
    """One run: times from nothing (n,), measured states (n, nx), forces (n, 1); of another machine from a moment on."""
    rng = np.random.default_rng([seed, 7])
    t = dt * np.arange(round(seconds / dt) + 1)
    cart = machine.system == "cartpole"
    push = 5.0 * _signal(t, rng, (0.1, 2.0)) if cart else 2.0 * _signal(t, rng, (0.05, 2.5))
    y = [0.0, 0.0, pi + rng.uniform(-1.0, 1.0), 0.0] if cart else [0.0, 0.0]
    fine = max(1, int(np.ceil(dt / 0.005)))
    h, noise = dt / fine, np.array(machine.noise)
    rows, forces = np.empty((len(t), len(y))), np.empty((len(t), 1))
    for k in range(len(t)):
        if then is not None and t[k] >= moment:
            machine = then
        rows[k] = y + noise * rng.standard_normal(len(y))
        u = push[k] - (4.0 * rows[k, 0] + 3.0 * rows[k, 1]) / machine.values["g"] if cart else push[k]
        forces[k] = u
        for part in range(fine):
            white = machine.gust * rng.standard_normal(2) / sqrt(h)
            size, hertz, phase = machine.wave
            white[0] += size * sin(2.0 * pi * hertz * (t[k] + (part + 0.5) * h) + phase)
            y = step(lambda y, m=machine, u=u, white=white: m.rate(y, u, white), y, h)
    return t, rows, forces


def _signal(t: Array, rng: np.random.Generator, band: tuple[float, float]) -> Array:
    """Sines of random frequencies [Hz] and steps of random length, each of about unit size."""
    f = np.exp(rng.uniform(*np.log(band), size=6))
    out = np.sin(2 * np.pi * f[:, None] * t + rng.uniform(0, 2 * np.pi, 6)[:, None]).sum(0) / np.sqrt(3.0)
    edges = np.cumsum(rng.uniform(0.5, 3.0, int(t[-1] / 0.5) + 2))
    return np.asarray(out + rng.choice((-0.6, 0.0, 0.6), len(edges))[np.searchsorted(edges, t)])


def rates(q: Array, dt: float, how: str) -> Array:
    """Rates that a user makes of a position column (n,)."""
    if how == "backward":
        return np.diff(q, prepend=q[0]) / dt
    if how == "savgol":
        return np.asarray(savgol_filter(q, 11, 3, deriv=1, delta=dt))
    steepness = np.asarray(np.gradient(q, dt))
    return steepness if how == "gradient" else np.asarray(lfilter(*butter(2, 10.0 * 2.0 * dt), steepness))


def measured(q: Array, noise: float, counts: bool, rng: np.random.Generator) -> Array:
    """An encoder's reading: white noise of this size, or steps that round by as much (root mean square)."""
    if not counts:
        return np.asarray(q + noise * rng.standard_normal(q.shape))
    grain = noise * np.sqrt(12.0)
    return np.asarray(np.round(q / grain) * grain)


def sums_of_sines(t: Array, size: float, rng: np.random.Generator, low: float, high: float) -> Array:
    """A force (n,) of this standard deviation."""
    hertz = np.exp(rng.uniform(np.log(low), np.log(high), 8))
    phase = rng.uniform(0.0, 2.0 * np.pi, 8)
    return np.asarray(size / 2.0 * np.sin(2.0 * np.pi * hertz * t[:, None] + phase).sum(1))


def _true(
    system: str, values: dict[str, float], law: Law, *, seconds: float, dt: float, gust: float, rng: Any
) -> tuple[Array, Array]:
    """True states (n, nx) and forces (n, 1); the pole of a cart hangs."""
    cart = system == "cartpole"
    t = dt * np.arange(round(seconds / dt))
    u = sums_of_sines(t, values["force"], rng, 0.15 if cart else 0.08, 1.5)
    y = [0.0, 0.0, pi + rng.uniform(-0.6, 0.6), 0.0] if cart else [0.0, 0.0]
    fine = max(1, int(np.ceil(dt / 0.002)))
    h, out = dt / fine, np.empty((len(t), len(y)))
    for n, push in enumerate(u.tolist()):
        out[n] = y
        for _ in range(fine):
            white = gust * rng.standard_normal() / sqrt(h)
            push_of = lambda y, u=push, w=white: rate(system, values, y, u, w + law(y[0], y[1]), 0.0)  # noqa: E731
            y = step(push_of, y, h)
    return out, u[:, None]


spring, cart = partial(_true, "mass_spring_damper"), partial(_true, "cartpole")
