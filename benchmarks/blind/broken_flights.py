"""What people do to logs of multirotors alone; see `broken_faults`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass
class Table:
    """One run: times (n,), states (n, nx), inputs (n, nu), further columns by name."""

    t: Array
    x: Array
    u: Array
    extra: dict[str, Array] = field(default_factory=dict)

    def copy(self) -> Table:
        """A copy of all columns."""
        return Table(
            self.t.copy(), self.x.copy(), self.u.copy(), {k: v.copy() for k, v in self.extra.items()}
        )

    def rows(self, keep: NDArray[np.int64]) -> None:
        """Keep some rows, by number."""
        self.t, self.x, self.u = self.t[keep], self.x[keep], self.u[keep]
        self.extra = {k: v[keep] for k, v in self.extra.items()}


Log = list[Table]
Fault = Callable[[Log, Log, np.random.Generator], str]


def product(a: Array, b: Array) -> Array:
    """Hamilton product of quaternions (n, 4)."""
    w, x, y, z = a.T
    W, X, Y, Z = np.broadcast_to(b, a.shape).T
    return np.stack(
        [
            w * W - x * X - y * Y - z * Z,
            w * X + x * W + y * Z - z * Y,
            w * Y - x * Z + y * W + z * X,
            w * Z + x * Y - y * X + z * W,
        ],
        1,
    )


def turn(q: Array, v: Array, back: bool = False) -> Array:
    """Vectors (n, 3) turned by quaternions (n, 4), or back."""
    c = q * np.array([1.0, -1.0, -1.0, -1.0])
    a, b = (c, q) if back else (q, c)
    return product(product(a, np.concatenate([np.zeros((len(v), 1)), v], 1)), b)[:, 1:]


def motors_swapped(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Two columns of motors exchanged."""
    i, j = (int(k) for k in rng.choice(log[0].u.shape[1], 2, replace=False))
    for run in log:
        run.u[:, [i, j]] = run.u[:, [j, i]]
    return f"u_{i + 1} and u_{j + 1} swapped"


def motors_rotated(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Columns of motors counted from another one, or in another order."""
    n = log[0].u.shape[1]
    order = np.roll(np.arange(n), int(rng.integers(1, n))) if rng.random() < 0.5 else np.arange(n)[::-1]
    for run in log:
        run.u = run.u[:, order]
    return f"motors in the order {(order + 1).tolist()}"


def ned_frd(log: Log, other: Log, rng: np.random.Generator) -> str:
    """All states in NED and FRD."""
    half = np.sqrt(0.5)
    for run in log:
        run.x[:, 0:6] = run.x[:, [1, 0, 2, 4, 3, 5]] * [1, 1, -1, 1, 1, -1]
        # q_ned_frd = (0, s, s, 0) q (0, 1, 0, 0)
        q = product(
            np.tile([0.0, half, half, 0.0], (len(run.x), 1)),
            product(run.x[:, 6:10], np.array([0.0, 1.0, 0.0, 0.0])),
        )
        run.x[:, 6:10] = q
        run.x[:, 11:13] *= -1.0
    return "states in NED, FRD"


def ned_world(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Position and velocity in NED, the attitude in ENU."""
    for run in log:
        run.x[:, 0:6] = run.x[:, [1, 0, 2, 4, 3, 5]] * [1, 1, -1, 1, 1, -1]
    return "positions and velocities in NED, the attitude in ENU"


def down_positive(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Height counted downwards, with its velocity."""
    for run in log:
        run.x[:, [2, 5]] *= -1.0
    return "p_z and v_z positive downwards"


def frd_rates(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Body rates in FRD, the attitude in FLU."""
    for run in log:
        run.x[:, 11:13] *= -1.0
    return "body rates in FRD"


def body_velocity(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Velocities along the body's axes."""
    for run in log:
        run.x[:, 3:6] = turn(run.x[:, 6:10], run.x[:, 3:6], back=True)
    return "velocities in the body's axes"


def world_turned(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Position and velocity in a world whose x axis is the attitude's y axis."""
    for run in log:
        run.x[:, 0:6] = run.x[:, [1, 0, 2, 4, 3, 5]] * [-1, 1, 1, -1, 1, 1]
    return "positions and velocities turned by 90 deg against the attitude"


def quaternion_xyzw(log: Log, other: Log, rng: np.random.Generator) -> str:
    """The scalar last."""
    for run in log:
        run.x[:, 6:10] = run.x[:, [7, 8, 9, 6]]
    return "quaternion xyzw"


def quaternion_conjugate(log: Log, other: Log, rng: np.random.Generator) -> str:
    """World to body."""
    for run in log:
        run.x[:, 7:10] *= -1.0
    return "quaternion world to body"


def rates_deg(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Body rates in deg/s."""
    for run in log:
        run.x[:, 10:13] = np.degrees(run.x[:, 10:13])
    return "rates in deg/s"


def inputs_percent(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Commands in percent."""
    for run in log:
        run.u *= 100.0
    return "inputs in percent"


def inputs_pwm(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Commands in microseconds."""
    for run in log:
        run.u = np.round(1000.0 + 1000.0 * run.u)
    return "inputs as pulse widths"


def inputs_two_sided(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Commands in [-1, 1]."""
    for run in log:
        run.u = 2.0 * run.u - 1.0
    return "inputs in [-1, 1]"


def motor_of_another_run(log: Log, other: Log, rng: np.random.Generator) -> str:
    """In one run, one motor's column is that of another run."""
    k, j = int(rng.integers(len(log))), int(rng.integers(log[0].u.shape[1]))
    source = log[(k + 1) % len(log)].u[:, j]
    log[k].u[:, j] = np.resize(source, len(log[k].u))
    return f"u_{j + 1} of run_{k} is of another run"


def motor_constant(log: Log, other: Log, rng: np.random.Generator) -> str:
    """One motor's column holds one value."""
    j = int(rng.integers(log[0].u.shape[1]))
    value = float(np.mean([run.u[:, j].mean() for run in log]))
    for run in log:
        run.u[:, j] = np.round(value, 3)
    return f"u_{j + 1} constant"
