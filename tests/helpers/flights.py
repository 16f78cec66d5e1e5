"""Smooth flights whose position, attitude and rates agree exactly with their derivatives; no physics."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data.quaternion import multiply

Array = NDArray[np.float64]


def flight(
    seconds: float, *, dt: float = 0.01, motors: int = 6, seed: int = 0, clock: float = 1.0
) -> tuple[Array, Array, Array]:
    """t (n,), x (n, 13), u (n, motors); each logged second holds `clock` physical seconds."""
    t, x, u = _flight(seconds, dt, motors, seed, clock)
    return t.copy(), x.copy(), u.copy()


@lru_cache
def _flight(seconds: float, dt: float, motors: int, seed: int, clock: float) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(seed)
    t = dt * np.arange(round(seconds / dt) + 1)
    true = clock * t
    a, f, s = rng.uniform(0.3, 0.8, (3, 3)), rng.uniform(0.8, 2.0, (3, 3)), rng.uniform(0, 6, (3, 3))
    p = (a[..., None] * np.sin(f[..., None] * true + s[..., None])).sum(axis=1).T
    v = (a[..., None] * f[..., None] * np.cos(f[..., None] * true + s[..., None])).sum(axis=1).T

    def rates(time: Array) -> Array:
        return (a[::-1, :, None] * np.cos(f[..., None] * time + s[::-1, :, None])).sum(axis=1).T

    w = rates(true)
    half = 0.5 * clock * dt * rates(true[:-1] + 0.5 * clock * dt)
    angle = np.linalg.norm(half, axis=1, keepdims=True)
    steps = np.concatenate([np.cos(angle), half * np.sinc(angle / np.pi)], axis=1)
    q = np.empty((len(t), 4))
    q[0] = 1.0, 0.0, 0.0, 0.0
    for k, step in enumerate(steps):
        q[k + 1] = multiply(q[k], step)
    u = 0.4 + 0.1 * np.sin(np.outer(true, rng.uniform(1, 5, motors)) + rng.uniform(0, 6, motors))
    return t, np.concatenate([p, v, q, w], axis=1), u
