"""Hexacopters flown by sticks through an attitude controller, by NumPy alone: nothing here is the package's.

Rigid body with motor lag, drag along the body's axes and gusts (Ornstein-Uhlenbeck forces and moments), 500 Hz, logged
at 100 Hz with sensor noise. Sticks ask for roll, pitch, yaw rate and climb; nobody holds the place. The controller acts
on the logged states ("logged"), at the same times on sensors of its own ("other"), or at 500 Hz on sensors of its own
("fast").
"""

from __future__ import annotations

from math import exp, sqrt

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data import Run

Array = NDArray[np.float64]

TRUTH = {
    "thrust_gain": 4.6,
    "roll_gain": 108.0,
    "pitch_gain": 108.0,
    "yaw_gain": 3.4,
    "motor_lag.time_constant": 0.05,
}
STICKS = ("stick_roll", "stick_pitch", "stick_yaw", "stick_climb")
_MIX = np.array(  # roll, pitch, yaw
    [[-1, 1, 0.5, -0.5, -0.5, 0.5], [0, 0, -0.866, 0.866, -0.866, 0.866], [1, -1, 1, -1, -1, 1]]
)
_GAINS, _DRAG, _RATIO = np.array([108.0, 108.0, 3.4]), np.array([0.15, 0.15, 0.05]), 0.7
_NOISE = np.array([0.003] * 3 + [0.01] * 3 + [0.003] * 3 + [0.02] * 3)  # p, v, attitude, rates
_H, _EVERY = 0.002, 5
_GUST = ((0.6, 1.0), (np.array([5.0, 5.0, 0.5]), 0.2))  # force [m/s2], moment [rad/s2]; time constants [s]


def _turned(q: Array, v: Array) -> Array:
    """Body vectors in the world."""
    a = 2.0 * np.cross(q[:, 1:], v)
    return np.asarray(v + q[:, :1] * a + np.cross(q[:, 1:], a))


def _times(a: Array, b: Array) -> Array:
    w = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(1, keepdims=True)
    return np.concatenate((w, a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])), 1)


def _small(angle: Array) -> Array:
    """Unit quaternions of small turns (n, 3)."""
    q = np.concatenate((np.ones((len(angle), 1)), 0.5 * angle), 1)
    return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))


def _seen(p: Array, v: Array, q: Array, w: Array, noise: Array) -> Array:
    """A measured state (n, 13)."""
    return np.concatenate(
        (p + noise[:, :3], v + noise[:, 3:6], _times(q, _small(noise[:, 6:9])), w + noise[:, 9:]), 1
    )


def _wander(rng: np.random.Generator, n: int, width: float) -> Array:
    keep, out = exp(-_H / width), rng.standard_normal((n, 4))
    for _ in range(2):
        last = np.zeros(4)
        for k in range(n):
            last = keep * last + (1 - keep) * out[k]
            out[k] = last
    return np.asarray(out / out.std(0))


def _commands(x: Array, stick: Array) -> Array:
    """Motor commands (n, 6) from measured states (n, 13) and sticks (n, 4)."""
    q, w, v = x[:, 6:10], x[:, 10:], x[:, 3:6]
    roll = np.arctan2(2 * (q[:, 0] * q[:, 1] + q[:, 2] * q[:, 3]), 1 - 2 * (q[:, 1] ** 2 + q[:, 2] ** 2))
    pitch = np.arcsin(np.clip(2 * (q[:, 0] * q[:, 2] - q[:, 3] * q[:, 1]), -1, 1))
    wanted = np.stack(
        (5.0 * (0.2 * stick[:, 0] - roll), 5.0 * (0.2 * stick[:, 1] - pitch), 0.6 * stick[:, 2]), 1
    )
    turn = np.array([9.0, 9.0, 3.0]) * (wanted - w) / _GAINS
    lift = (9.81 + 1.5 * (0.5 * stick[:, 3] - v[:, 2])) / np.maximum(np.cos(roll) * np.cos(pitch), 0.5) / 4.6
    return np.asarray(np.clip(lift[:, None] / 6 + turn @ np.linalg.pinv(_MIX).T, 0.0, 1.0))


def fly(controller: str, *, seeds: range, seconds: float = 45.0) -> list[list[Run]]:
    """Three flights for each seed, with the columns `STICKS`."""
    m, n = 3 * len(seeds), round(seconds / _H)
    rngs = [np.random.default_rng([seed, flight, 5]) for seed in seeds for flight in range(3)]
    stick = np.stack([_wander(r, n, 0.15) for r in rngs], 1)
    stick = np.repeat(stick[::_EVERY], _EVERY, 0)[:n]  # sticks come at the rate of the log
    p, v, w, a = np.zeros((m, 3)), np.zeros((m, 3)), np.zeros((m, 3)), np.full((m, 6), 9.81 / 4.6 / 6)
    q = np.tile([1.0, 0, 0, 0], (m, 1))
    force, moment = np.zeros((m, 3)), np.zeros((m, 3))
    (size_f, time_f), (size_m, time_m) = _GUST
    keep_f, keep_m, keep = exp(-_H / time_f), exp(-_H / time_m), exp(-_H / TRUTH["motor_lag.time_constant"])
    xs, us = np.empty((n // _EVERY, m, 13)), np.empty((n // _EVERY, m, 6))
    own = np.random.default_rng([seeds[0], 7])
    for i in range(n):
        if i % _EVERY == 0:
            logged = _seen(p, v, q, w, _NOISE * own.standard_normal((m, 12)))
            xs[i // _EVERY] = logged
        if controller == "fast" or i % _EVERY == 0:
            mine = (
                logged if controller == "logged" else _seen(p, v, q, w, _NOISE * own.standard_normal((m, 12)))
            )
            u = _commands(mine, stick[i])
        if i % _EVERY == 0:
            us[i // _EVERY] = u
        held = a
        a = u + keep * (a - u)
        mean = 0.5 * (held + a)
        force = keep_f * force + size_f * sqrt(1 - keep_f**2) * own.standard_normal((m, 3))
        moment = keep_m * moment + size_m * sqrt(1 - keep_m**2) * own.standard_normal((m, 3))
        turn = _GAINS * (mean @ _MIX.T) + moment
        turn[:, 0] -= (1 / _RATIO - 1) * w[:, 1] * w[:, 2]
        turn[:, 1] += (1 / _RATIO - 1) * w[:, 2] * w[:, 0]
        half = w + 0.5 * _H * turn
        middle = _times(q, _small(0.5 * _H * w))
        back = _turned(middle * [1, -1, -1, -1], v)
        push = -_DRAG * back + force
        push[:, 2] += 4.6 * mean.sum(1)
        pull = _turned(middle, push) - [0, 0, 9.81]
        p, v = p + _H * (v + 0.5 * _H * pull), v + _H * pull
        q, w = _times(q, _small(_H * half)), w + _H * turn
    t = _EVERY * _H * np.arange(n // _EVERY)
    runs = [
        Run(f"flight_{j}", t, xs[:, j], us[:, j], extra=dict(zip(STICKS, stick[::_EVERY, j].T, strict=True)))
        for j in range(m)
    ]
    return [runs[3 * k : 3 * k + 3] for k in range(len(seeds))]
