"""References: where a flight should be, as states on a fine grid of time.

A path gives positions and heading with their derivatives; the state that flies it follows from flatness (Mellinger and
Kumar, ICRA 2011), of which this knows no more than gravity, as the supplement's references do:

    z_body = (a + g) / |a + g|,   heading = yaw,   omega = 2 vec(q^-1 dq/dt)
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.errors import ConfigError
from nsde_torch.rotation import rotation_between
from nsde_torch.systems.multirotor import GRAVITY


@dataclass(frozen=True)
class FlightPath:
    """A path on a grid of time."""

    name: str  # what it is called in messages and figures
    dt: float  # step of the grid [s]
    p: Array  # positions (n, 3) [m]
    v: Array  # velocities (n, 3) [m/s]
    a: Array  # accelerations (n, 3) [m/s2]
    yaw: Array  # headings (n,) [rad], without jumps of 2 pi
    about: dict[str, object] = field(default_factory=dict)  # what it was made of, for the record

    @property
    def duration(self) -> float:
        """Length [s]."""
        return (len(self.p) - 1) * self.dt


def attitude_along(axis: Tensor, yaw: Tensor) -> Tensor:
    """Quaternions (n, 4): the shortest turn from up to a thrust axis (n, 3), after the turn to a heading (n,) [rad]."""
    zx, zy, zz = axis.unbind(1)
    c = torch.sqrt(0.5 * (1.0 + zz))
    tx, ty = -0.5 * zy / c, 0.5 * zx / c
    cy, sy = torch.cos(0.5 * yaw), torch.sin(0.5 * yaw)
    return torch.stack((c * cy, tx * cy + ty * sy, ty * cy - tx * sy, c * sy), 1)


def states_of(path: FlightPath) -> Tensor:
    """States (n, 13) of a multirotor that flies a path, in double precision.

    Raises:
        ConfigError: the path falls freely somewhere, where no attitude follows from it.
    """
    force = path.a + np.array([0.0, 0.0, GRAVITY])
    size = np.linalg.norm(force, axis=1)
    if size.min() < 0.05 * GRAVITY or (force[:, 2] / size).min() < -0.9:
        at = int(size.argmin())
        raise ConfigError(
            f"reference {path.name!r} falls freely at {at * path.dt:.2f} s, where no attitude follows from it. "
            "Fly slower."
        )
    q = attitude_along(torch.from_numpy(force / size[:, None]), torch.from_numpy(path.yaw))
    turn = rotation_between(q[:-2], q[2:]) / (2.0 * path.dt)
    omega = torch.cat((turn[:1], turn, turn[-1:]))
    return torch.cat((torch.from_numpy(np.hstack((path.p, path.v))), q, omega), 1)


@final
class Reference:
    """States to track, looked up by time; before the start and after the end the first and last are held, at rest.

    Args:
        path: The path.

    Attributes:
        name, dt, duration: See `FlightPath`.
        states: States on the grid (n, 13).
    """

    def __init__(self, path: FlightPath) -> None:
        self.path, self.name, self.dt, self.duration = path, path.name, path.dt, path.duration
        self.states = states_of(path)
        self._rest = self.states[[0, -1]].clone()
        for row, yaw in zip(self._rest, path.yaw[[0, -1]], strict=True):
            row[3:6], row[7:9], row[10:] = 0.0, 0.0, 0.0
            row[6], row[9] = float(np.cos(0.5 * yaw)), float(np.sin(0.5 * yaw))

    def at(self, t: Tensor) -> Tensor:
        """States (..., 13) at times (...) [s], by interpolation."""
        when, table = t.numpy()[..., None], self.states.numpy()
        s = np.clip(when.astype(np.float64) / self.dt, 0.0, len(table) - 1.0)
        low = np.minimum(s.astype(np.int64), len(table) - 2)
        share, low = s - low, low[..., 0]
        x = (1.0 - share) * table[low] + share * table[low + 1]
        q = x[..., 6:10]
        q /= np.sqrt((q * q).sum(-1, keepdims=True))
        x = np.where(when < 0.0, self._rest[0].numpy(), x)
        return torch.from_numpy(np.where(when > self.duration, self._rest[1].numpy(), x))

    def window(self, t: float, *, dt: float, steps: int) -> Tensor:
        """States (steps, 13) at t + dt, ..., t + steps dt: what a plan made at t is to track."""
        return self.at(t + dt * torch.arange(1, steps + 1, dtype=torch.float64))
