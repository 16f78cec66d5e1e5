"""References: where a machine should be, as states on a fine grid of time.

A path gives positions and heading with their derivatives; the state that flies it follows from flatness (Mellinger and
Kumar, ICRA 2011), of which this knows no more than gravity, as the supplement's references do:

    z_body = (a + g) / |a + g|,   heading = yaw,   omega = 2 vec(q^-1 dq/dt)
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import final

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.data.csv_folder import csv_rows
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.rotation import rotation_between
from nsde_torch.systems import System
from nsde_torch.systems.multirotor import GRAVITY

GRID = 0.01  # step of the grid of a reference [s]
_LONGEST_S = 36_000.0  # of a course


def at_rest(system: System, dtype: torch.dtype) -> Tensor:
    """The state (nx,) of a machine at its origin, at rest; of a multirotor, level."""
    x = torch.zeros(system.nx, dtype=dtype)
    if system.quaternion is not None:
        x[system.quaternion.start] = 1.0
    return x


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


@dataclass(eq=False)
class StateReference:
    """States to track, looked up by time; before the start and after the end the first and last are held."""

    name: str  # what it is called in messages and figures
    dt: float  # step of the grid of time [s]
    states: Tensor  # on the grid (n, nx)
    about: Mapping[str, object] = field(default_factory=dict)  # what it was made of, for the record

    @property
    def duration(self) -> float:
        """Length [s]."""
        return (len(self.states) - 1) * self.dt

    def at(self, t: Tensor) -> Tensor:
        """States (..., nx) at times (...) [s], by interpolation."""
        table = self.states.numpy()
        s = np.clip(t.numpy()[..., None].astype(np.float64) / self.dt, 0.0, len(table) - 1.0)
        low = np.minimum(s.astype(np.int64), len(table) - 2)
        share, low = s - low, low[..., 0]
        return torch.from_numpy((1.0 - share) * table[low] + share * table[low + 1])

    def window(self, t: float, *, dt: float, steps: int) -> Tensor:
        """States (steps, nx) at t + dt, ..., t + steps dt: what a plan made at t is to track."""
        return self.at(t + dt * torch.arange(1, steps + 1, dtype=torch.float64))


@final
class Reference(StateReference):
    """States of a flight along a path, at rest before the start and after the end."""

    def __init__(self, path: FlightPath) -> None:
        super().__init__(path.name, path.dt, states_of(path), path.about)
        self.path = path
        self._rest = self.states[[0, -1]].clone()
        for row, yaw in zip(self._rest, path.yaw[[0, -1]], strict=True):
            row[3:6], row[7:9], row[10:] = 0.0, 0.0, 0.0
            row[6], row[9] = float(np.cos(0.5 * yaw)), float(np.sin(0.5 * yaw))

    def at(self, t: Tensor) -> Tensor:
        """States (..., 13) at times (...) [s], by interpolation."""
        when, x = t.numpy()[..., None], super().at(t).numpy()
        q = x[..., 6:10]
        q /= np.sqrt((q * q).sum(-1, keepdims=True))
        x = np.where(when < 0.0, self._rest[0].numpy(), x)
        return torch.from_numpy(np.where(when > self.duration, self._rest[1].numpy(), x))


def setpoint(system: System, states: Mapping[str, float], *, duration: float) -> StateReference:
    """A state to reach and to hold: that of the origin, at rest, but for the `states` that are given by name.

    ConfigError: a name that is no state, a value that is not finite, or no duration.
    """
    unknown = sorted(set(states) - set(system.state_names))
    wrong = [name for name, value in states.items() if not isfinite(value)]
    if wrong or not duration > 0:
        raise ConfigError(
            f"a set point needs finite states and a duration above 0; got {dict(states)}, {duration}."
        )
    if unknown:
        raise ConfigError(f"system {system.name!r} has no state {unknown[0]!r}; {_named(system)}")
    row = at_rest(system, torch.float64)
    for name, value in states.items():
        row[system.state_names.index(name)] = float(value)
    return StateReference("setpoint", duration, row.repeat(2, 1), {"states": dict(states)})


def course(system: System, file: str | Path) -> StateReference:
    """States over time of a CSV file: `t` [s] and columns of states; velocities that it lacks are those of positions.

    DataError: the file or a column is missing, a number is none, or times do not increase.
    """
    path = Path(file)
    rows = csv_rows(path, ("t",), what="reference", remedy="Name a CSV file.")
    names = [name for name in system.state_names if name in rows[0]]
    if not names:
        raise DataError(f"reference {path} has no column of a state; {_named(system)}")
    try:
        table = np.array([[float(row[name]) for name in ("t", *names)] for row in rows])
    except (TypeError, ValueError) as error:
        raise DataError(f"reference {path} holds something that is no number ({error}).") from error
    t = table[:, 0] - table[0, 0]
    if len(t) < 2 or not np.isfinite(table).all() or (np.diff(t) <= 0).any():
        raise DataError(f"reference {path}: `t` must increase over two rows or more, and all be finite.")
    if t[-1] > _LONGEST_S:
        raise DataError(f"reference {path} lasts {t[-1]:.3g} s, beyond {_LONGEST_S:g} s: is `t` in seconds?")
    for k, name in enumerate(names, start=1):  # an angle that was wrapped goes on
        if system.state_units[system.state_names.index(name)] == "rad":
            table[:, k] = np.unwrap(table[:, k])
    from scipy.interpolate import PchipInterpolator  # half a second, which a circle does not need

    grid = np.arange(0.0, t[-1] + 0.5 * GRID, GRID)
    x = at_rest(system, torch.float64).repeat(len(grid), 1).numpy()
    through = PchipInterpolator(t, table[:, 1:])  # monotone between rows: a step does not ring
    x[:, [system.state_names.index(name) for name in names]] = through(np.minimum(grid, t[-1]))
    rates = through.derivative()(np.minimum(grid, t[-1]))
    for position, velocity, _ in system.position_derivatives:
        if position in names and velocity not in names:
            x[:, system.state_names.index(velocity)] = rates[:, names.index(position)]
    return StateReference(path.stem, GRID, torch.from_numpy(x), {"file": str(path), "columns": names})


def _named(system: System) -> str:
    return f"it has {', '.join(system.state_names)}."
