"""Springs and carts of the broken-log study: simulators of their own, in NumPy, that share no code with `nsde_torch`.

    spring    q'' = -k q - b v + g u + what a case holds                                 (over mass)
    cart      a = u / M + s l w^2 sin(theta) + what a case holds,   s = m / M
              w' = (G sin(theta) - a cos(theta)) / (l (4/3 - s cos(theta)^2)),   x'' = a - s l w' cos(theta)
              (Barto, Sutton and Anderson, IEEE Transactions on Systems, Man, and Cybernetics 13 (1983))

by Runge-Kutta 4 at a fraction of the log's step, inputs held over a row. Forces are sums of sines and steps; that of
the cart also holds it near the middle by what the log measures.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
G = 9.8
STATES = {"mass_spring_damper": ("q", "q_dot"), "cartpole": ("x", "x_dot", "theta", "theta_dot")}
FRICTION = ("coulomb", "quadratic", "hardening")


@dataclass(frozen=True)
class Small:
    """A spring or a cart.

    Args:
        system: `mass_spring_damper` or `cartpole`.
        values: Its parameters by the names above.
        effects: What it holds beside.
        noise: Standard deviations of its sensors.
        gust: White force or torque, by the root of a second [m/s1.5].
        steady: A force on the spring or the cart that never changes [m/s2].
    """

    system: str
    values: dict[str, float]
    effects: dict[str, dict[str, Any]] = field(default_factory=dict)
    noise: tuple[float, ...] = ()
    gust: float = 0.02
    steady: float = 0.0


def small(system: str, rng: np.random.Generator, effect: bool) -> Small:
    """A machine with random parameters; with one effect of random size, or none."""
    level = float(rng.uniform(0.5, 1.5))
    if system == "mass_spring_damper":
        values = {"k": rng.uniform(0.6, 8.0), "b": rng.uniform(0.2, 1.0), "g": rng.uniform(0.5, 2.0)}
        noise: tuple[float, ...] = (0.004, 0.01)
        names: tuple[str, ...] = FRICTION
    else:
        values = {"g": rng.uniform(0.6, 1.3), "s": rng.uniform(0.06, 0.25), "l": rng.uniform(0.25, 0.7)}
        noise, names = (0.004, 0.01, 0.01, 0.03), FRICTION[:2]
    held: dict[str, dict[str, Any]] = {}
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
    y = np.zeros(len(STATES[machine.system]))
    if cart:
        y[2] = np.pi + rng.uniform(-1.0, 1.0)
    fine = max(1, int(np.ceil(dt / 0.005)))
    h = dt / fine
    noise = np.array(machine.noise)
    rows, forces = np.empty((len(t), len(y))), np.empty((len(t), 1))
    for k in range(len(t)):
        if then is not None and t[k] >= moment:
            machine = then
        rows[k] = y + noise * rng.standard_normal(len(y))
        u = push[k] - (4.0 * rows[k, 0] + 3.0 * rows[k, 1]) / machine.values["g"] if cart else push[k]
        forces[k] = u
        for _ in range(fine):
            white = machine.gust * rng.standard_normal(2) / np.sqrt(h)
            k1 = _rate(machine, y, u, white)
            k2 = _rate(machine, y + 0.5 * h * k1, u, white)
            k3 = _rate(machine, y + 0.5 * h * k2, u, white)
            y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + _rate(machine, y + h * k3, u, white))
    return t, rows, forces


def _signal(t: Array, rng: np.random.Generator, band: tuple[float, float]) -> Array:
    """Sines of random frequencies [Hz] and steps of random length, each of about unit size."""
    f = np.exp(rng.uniform(*np.log(band), size=6))
    out = np.sin(2 * np.pi * f[:, None] * t + rng.uniform(0, 2 * np.pi, 6)[:, None]).sum(0) / np.sqrt(3.0)
    edges = np.cumsum(rng.uniform(0.5, 3.0, int(t[-1] / 0.5) + 2))
    return np.asarray(out + rng.choice((-0.6, 0.0, 0.6), len(edges))[np.searchsorted(edges, t)])


def _rate(machine: Small, y: Array, u: float, white: Array) -> Array:
    p, v = machine.values, y[1]
    own = white[0] + machine.steady
    for name, e in machine.effects.items():
        if name == "coulomb":
            own -= e["size"] * np.tanh(v / 0.01)
        elif name == "quadratic":
            own -= e["size"] * abs(v) * v
        elif name == "damping_by_place":
            own -= e["size"] * y[0] ** 2 * v
        elif name == "slope":
            own -= e["size"] * np.sin(2.0 * y[0])
        else:
            own -= e["size"] * y[0] ** 3
    if machine.system == "mass_spring_damper":
        return np.array([v, -p["k"] * y[0] - p["b"] * v + p["g"] * u + own])
    sin, cos, w = np.sin(y[2]), np.cos(y[2]), y[3]
    a = p["g"] * u + p["s"] * p["l"] * w * w * sin + own
    turn = (G * sin - a * cos) / (p["l"] * (4 / 3 - p["s"] * cos * cos)) + white[1]
    return np.array([v, a - p["s"] * p["l"] * turn * cos, w, turn])
