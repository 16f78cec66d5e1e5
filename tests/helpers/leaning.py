"""A flight of a quadrotor that speeds up where its thrust leans, made without any of the package's physics."""

import numpy as np
from scipy.spatial.transform import Rotation

from nsde_torch.data.quaternion import increments
from nsde_torch.data.raw import RawRun

G = 9.81


def leaning_flight(seconds: float, *, dt: float = 0.01, seed: int = 0, yaw: float = 0.4) -> RawRun:
    """Positions are sums of sines, the third axis is along acceleration plus gravity, the heading sways [rad]."""
    rng = np.random.default_rng(seed)
    t = dt * np.arange(round(seconds / dt) + 1)
    f, phase = rng.uniform(0.6, 2.5, (3, 5)), rng.uniform(0, 6, (3, 5))
    size = np.array([0.5, 0.5, 0.15])[:, None] / f
    wave = f[..., None] * t + phase[..., None]
    p = (size[..., None] * np.sin(wave)).sum(1).T
    v = ((size * f)[..., None] * np.cos(wave)).sum(1).T
    a = (-(size * f**2)[..., None] * np.sin(wave)).sum(1).T
    third = a + np.array([0.0, 0.0, G])
    third /= np.linalg.norm(third, axis=1, keepdims=True)
    heading = yaw * np.sin(0.7 * t)
    ahead = np.stack([np.cos(heading), np.sin(heading), np.zeros_like(t)], axis=1)
    left = np.cross(third, ahead)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    matrix = np.stack([np.cross(left, third), left, third], axis=2)
    q = Rotation.from_matrix(matrix).as_quat()[:, [3, 0, 1, 2]]
    sign = np.cumprod(np.sign((q[1:] * q[:-1]).sum(1)))
    q *= np.where(np.append(1.0, sign) < 0, -1.0, 1.0)[:, None]
    step = increments(q) / dt
    w = np.concatenate([step[:1], 0.5 * (step[1:] + step[:-1]), step[-1:]])
    u = 0.5 + 0.1 * np.sin(np.outer(t, rng.uniform(1, 5, 4)) + rng.uniform(0, 6, 4))
    return RawRun("run", t, np.concatenate([p, v, q, w], axis=1), u)


def same_flight(run: RawRun, made: RawRun, atol: float) -> bool:
    """Whether states are those of the flight that was made, an attitude up to its sign."""
    q, own = run.x[:, 6:10], made.x[:, 6:10]
    x = run.x.copy()
    x[:, 6:10] = q * np.sign((q * own).sum(axis=1))[:, None]
    return bool(np.abs(x - made.x).max() < atol)
