"""What people do to logs: each function breaks a log in one way and says which words would name it.

A log is a list of `Table`s, one a run. A fault takes the log, another machine's log of the same kind, and random
numbers, and returns what was done in words; the tables are changed in place. The last entry of `FAULTS` is a regular
expression that has to be found in what a command says for the fault to count as named.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from loop_machine import product, rotation
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import butter, sosfilt, sosfilt_zi, sosfiltfilt

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


# ---- changes of columns that are the same in every row --------------------------------------------------


def _each(said: str, change: Callable[[Table], None]) -> Fault:
    """A fault that changes every run alike."""

    def fault(log: Log, other: Log, rng: np.random.Generator) -> str:
        for run in log:
            change(run)
        return said

    return fault


def _states(columns: slice | list[int], made: Callable[[Array], Array], said: str) -> Fault:
    """Columns of the states that are made of all states (n, nx)."""

    def change(run: Table) -> None:
        run.x[:, columns] = made(run.x)

    return _each(said, change)


def _inputs(made: Callable[[Array], Array], said: str) -> Fault:
    """Inputs (n, nu) written in another unit or with another sign."""

    def change(run: Table) -> None:
        run.u = made(run.u)

    return _each(said, change)


def _ned(x: Array) -> Array:
    """Positions and velocities (n, 6) in NED."""
    return x[:, [1, 0, 2, 4, 3, 5]] * [1, 1, -1, 1, 1, -1]


def _ned_frd(run: Table) -> None:
    half = np.sqrt(0.5)
    run.x[:, 0:6] = _ned(run.x)
    # q_ned_frd = (0, s, s, 0) q (0, 1, 0, 0)
    turned = product(run.x[:, 6:10], np.array([[0.0, 1.0, 0.0, 0.0]]))
    run.x[:, 6:10] = product(np.array([[0.0, half, half, 0.0]]), turned)
    run.x[:, 11:13] *= -1.0


def _in_the_body(x: Array) -> Array:
    """Velocities (n, 3) along the body's axes."""
    return np.einsum("bji,bj->bi", rotation(x[:, 6:10]), x[:, 3:6])


def _milliseconds(run: Table) -> None:
    run.t = run.t * 1e3


# ---- multirotors ----------------------------------------------------------------------------------------


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


# ---- all machines --------------------------------------------------------------------------------------


def length_unit(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Positions, sometimes with their velocities, in mm, cm or ft."""
    nx, factor = log[0].x.shape[1], float(rng.choice([1000.0, 100.0, 3.28084]))
    p, v = {13: ([0, 1, 2], [3, 4, 5]), 2: ([0], [1]), 4: ([0], [1])}[nx]
    both = nx == 13 and rng.random() < 0.5
    for run in log:
        run.x[:, [*p, *v] if both else p] *= factor
    return f"positions{' and velocities' if both else ''} times {factor:g}"


def angle_deg(log: Log, other: Log, rng: np.random.Generator) -> str:
    """The pole's angle, sometimes with its rate, in degrees."""
    both = rng.random() < 0.5
    for run in log:
        run.x[:, 2:4] = np.degrees(run.x[:, 2:4]) if both else run.x[:, 2:4]
        run.x[:, 2] = run.x[:, 2] if both else np.degrees(run.x[:, 2])
    return f"theta{' and theta_dot' if both else ''} in degrees"


def one_axis_flipped(log: Log, other: Log, rng: np.random.Generator) -> str:
    """A velocity logged with the other sign."""
    k = {13: 3 + int(rng.integers(3)), 2: 1, 4: int(rng.choice([1, 3]))}[log[0].x.shape[1]]
    for run in log:
        run.x[:, k] *= -1.0
    return f"state {k} with the other sign"


def _later(run: Table, columns: list[int], rows: float, inputs: bool = False) -> None:
    table, k = (run.u if inputs else run.x), np.arange(len(run.t))
    at = np.clip(k - rows, 0, len(k) - 1)
    for c in columns:  # inputs are held, states are straight between rows
        table[:, c] = table[np.floor(at + 1e-9).astype(int), c] if inputs else np.interp(at, k, table[:, c])


def _stream(log: Log, columns: list[int], rng: np.random.Generator, inputs: bool = False) -> str:
    shift = float(rng.uniform(0.02, 0.15)) * (float(rng.choice([-1, 1])) if not inputs else 1.0)
    for run in log:
        rows = shift / float(np.median(np.diff(run.t)))
        _later(run, columns, rows, inputs)
        keep = np.arange(int(abs(rows)) + 1, len(run.t) - int(abs(rows)) - 1)
        run.rows(keep)
        if len(columns) == 4 and not inputs:
            run.x[:, 6:10] /= np.linalg.norm(run.x[:, 6:10], axis=1, keepdims=True)
    return f"shifted by {1e3 * shift:.0f} ms"


def position_late(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Positions shifted in time."""
    return "positions " + _stream(log, [0, 1, 2] if log[0].x.shape[1] == 13 else [0], rng)


def attitude_late(log: Log, other: Log, rng: np.random.Generator) -> str:
    """The attitude, or the angle, shifted in time."""
    return "attitude " + _stream(log, [6, 7, 8, 9] if log[0].x.shape[1] == 13 else [2], rng)


def rates_late(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Body rates, or the angle's rate, shifted in time."""
    return "rates " + _stream(log, [10, 11, 12] if log[0].x.shape[1] == 13 else [3], rng)


def pose_late(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Attitude and rates together shifted in time against the rest."""
    return "attitude and rates " + _stream(
        log, list(range(6, 13)) if log[0].x.shape[1] == 13 else [2, 3], rng
    )


def inputs_late(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Inputs logged late or early by 60 to 150 ms, beyond what a machine does by itself."""
    shift = float(rng.uniform(0.06, 0.15) * rng.choice([-1, 1]))
    for run in log:
        rows = shift / float(np.median(np.diff(run.t)))
        _later(run, list(range(run.u.shape[1])), rows, True)
        run.rows(np.arange(int(abs(rows)) + 1, len(run.t) - int(abs(rows)) - 1))
    return f"inputs shifted by {1e3 * shift:.0f} ms"


def smoothed(log: Log, other: Log, rng: np.random.Generator) -> str:
    """All states smoothed, by one of four smoothers that cut at 2 to 8 Hz."""
    cut, kind = float(np.exp(rng.uniform(np.log(2.0), np.log(8.0)))), int(rng.integers(4))
    for run in log:
        rate = 1.0 / float(np.median(np.diff(run.t)))
        sos = butter(4 if kind == 0 else 2, cut, fs=rate, output="sos")
        for k in range(run.x.shape[1]):
            c = run.x[:, k]
            if kind < 2:
                run.x[:, k] = sosfiltfilt(sos, c)
            elif kind == 2:
                run.x[:, k] = gaussian_filter1d(c, 0.187 * rate / cut, mode="nearest")
            else:
                run.x[:, k] = sosfilt(sos, c, zi=sosfilt_zi(sos) * c[0])[0]
        if run.x.shape[1] == 13:
            run.x[:, 6:10] /= np.linalg.norm(run.x[:, 6:10], axis=1, keepdims=True)
    return f"states smoothed, kind {kind} at {cut:.1f} Hz"


def clipped(log: Log, other: Log, rng: np.random.Generator) -> str:
    """One rate sensor clipped at its 90 to 97 % quantile."""
    k = {13: int(rng.integers(10, 13)), 2: 1, 4: int(rng.choice([1, 3]))}[log[0].x.shape[1]]
    level = float(np.quantile(np.abs(np.concatenate([run.x[:, k] for run in log])), rng.uniform(0.90, 0.97)))
    for run in log:
        run.x[:, k] = np.clip(run.x[:, k], -level, level)
    return f"state {k} clipped at {level:.3g}"


def resampled(log: Log, other: Log, rng: np.random.Generator) -> str:
    """States down by hold to a third to a tenth of the rate and up again by linear interpolation."""
    step = int(rng.integers(3, 11))
    for run in log:
        k = np.arange(len(run.t))
        for c in range(run.x.shape[1]):
            run.x[:, c] = np.interp(k, k[::step], run.x[::step, c])
        if run.x.shape[1] == 13:
            run.x[:, 6:10] /= np.linalg.norm(run.x[:, 6:10], axis=1, keepdims=True)
    return f"every {step}th row, straight lines between"


def duplicated(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Rows written twice."""
    for run in log:
        twice = rng.choice(len(run.t), len(run.t) // 20, replace=False)
        run.rows(np.sort(np.concatenate([np.arange(len(run.t)), twice])))
    return "5 % of the rows twice"


def two_machines(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Runs of another machine in the folder."""
    log[len(log) // 2 :] = [run.copy() for run in other[len(log) // 2 :]]
    return "half of the runs are of another machine"


def one_of_another(log: Log, other: Log, rng: np.random.Generator) -> str:
    """One run of another machine."""
    k = int(rng.integers(len(log)))
    log[k] = other[k].copy()
    return f"run_{k} is of another machine"


def state_constant(log: Log, other: Log, rng: np.random.Generator) -> str:
    """A state that holds one value."""
    k = int(rng.integers(log[0].x.shape[1] - 7)) if log[0].x.shape[1] == 13 else 1
    for run in log:
        run.x[:, k] = run.x[0, k]
    return f"state {k} constant"


def state_of_another_run(log: Log, other: Log, rng: np.random.Generator) -> str:
    """In one run, one velocity is that of another run."""
    k = int(rng.integers(len(log)))
    c = {13: 3 + int(rng.integers(3)), 2: 1, 4: 1}[log[0].x.shape[1]]
    log[k].x[:, c] = np.resize(log[(k + 1) % len(log)].x[:, c], len(log[k].x))
    return f"state {c} of run_{k} is of another run"


def gaps_unmarked(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Half a second to a second lost, three times a run, and the clock goes on as if nothing were."""
    for run in log:
        dt = float(np.median(np.diff(run.t)))
        keep = np.ones(len(run.t), dtype=bool)
        for at in rng.uniform(0.1, 0.85, 3) * len(run.t):
            keep[int(at) : int(at + rng.uniform(0.5, 1.0) / dt)] = False
        first = run.t[0]
        run.rows(np.flatnonzero(keep))
        run.t = first + dt * np.arange(len(run.t))
    return "three hidden gaps a run"


def wrapped_half(log: Log, other: Log, rng: np.random.Generator) -> str:
    """The signs of the quaternion change at random rows."""
    for run in log:
        flips = np.cumsum(rng.random(len(run.t)) < 0.002) % 2
        flips[0] = 0
        flips[len(flips) // 2] = 1
        run.x[:, 6:10] *= np.where(flips, -1.0, 1.0)[:, None]
    return "signs of the quaternion flip"


_WORLD = r"axes|frame|NED|ENU"
FAULTS: dict[str, tuple[Fault, str, str]] = {
    "two motors swapped": (motors_swapped, "m", r"order of the (inputs|motors)|u_\d.*(swap|exchang|order)"),
    "motors in another order": (motors_rotated, "m", r"order of the (inputs|motors)|u_\d.*(swap|order)"),
    "NED and FRD": (_each("states in NED, FRD", _ned_frd), "m", r"NED|FRD"),
    "NED positions, ENU attitude": (
        _states(slice(0, 6), _ned, "positions and velocities in NED, the attitude in ENU"),
        "m",
        _WORLD,
    ),
    "height downwards": (
        _states([2, 5], lambda x: -x[:, [2, 5]], "p_z and v_z positive downwards"),
        "m",
        r"NED|downwards|sign of '?p_z|p_z.*sign|axes",
    ),
    "rates in FRD": (
        _states(slice(11, 13), lambda x: -x[:, 11:13], "body rates in FRD"),
        "m",
        r"FRD|sign.*w_y|w_y.*sign|rates",
    ),
    "velocity in the body": (
        _states(slice(3, 6), _in_the_body, "velocities in the body's axes"),
        "m",
        r"body's axes",
    ),
    "world turned by 90 deg": (
        _states(
            slice(0, 6),
            lambda x: x[:, [1, 0, 2, 4, 3, 5]] * [-1, 1, 1, -1, 1, 1],
            "positions and velocities turned by 90 deg against the attitude",
        ),
        "m",
        _WORLD,
    ),
    "quaternion xyzw": (
        _states(slice(6, 10), lambda x: x[:, [7, 8, 9, 6]], "quaternion xyzw"),
        "m",
        r"scalar last",
    ),
    "quaternion conjugate": (
        _states(slice(7, 10), lambda x: -x[:, 7:10], "quaternion world to body"),
        "m",
        r"world into the body",
    ),
    "rates in deg/s": (
        _states(slice(10, 13), lambda x: np.degrees(x[:, 10:13]), "rates in deg/s"),
        "m",
        r"deg",
    ),
    "inputs in percent": (_inputs(lambda u: 100.0 * u, "inputs in percent"), "m", r"percent"),
    "inputs as pulse widths": (
        _inputs(lambda u: np.round(1000.0 + 1000.0 * u), "inputs as pulse widths"),
        "m",
        r"pulse width",
    ),
    "inputs in [-1, 1]": (_inputs(lambda u: 2.0 * u - 1.0, "inputs in [-1, 1]"), "m", r"-1|expected 0 to 1"),
    "a motor of another run": (motor_of_another_run, "m", r"u_\d|another machine|run_\d"),
    "a motor constant": (motor_constant, "m", r"never change"),
    "signs of the quaternion": (wrapped_half, "m", r"sign"),
    "unit of length": (length_unit, "msc", r"unit|metre|mm|ft|feet|SI"),
    "angle in degrees": (angle_deg, "c", r"deg"),
    "angle from hanging": (
        _states([2], lambda x: x[:, [2]] - np.pi, "theta counted from hanging"),
        "c",
        r"pi more|other side",
    ),
    "angle wrapped": (
        _states([2], lambda x: np.mod(x[:, [2]] + np.pi, 2 * np.pi) - np.pi, "theta wrapped"),
        "c",
        r"wrap",
    ),
    "force flipped": (
        _inputs(lambda u: -u, "sign of the force flipped"),
        "sc",
        r"opposite sign|sign of .?.?force",
    ),
    "a velocity flipped": (one_axis_flipped, "msc", r"sign|disagree|times as fast"),
    "positions shifted": (position_late, "msc", r"late|shift"),
    "attitude shifted": (attitude_late, "mc", r"late|shift"),
    "rates shifted": (rates_late, "mc", r"late|shift"),
    "attitude and rates shifted": (pose_late, "mc", r"late|shift|early"),
    "inputs shifted": (inputs_late, "msc", r"late|shift|early"),
    "states smoothed": (smoothed, "msc", r"smooth|went through"),
    "a sensor clipped": (clipped, "msc", r"clip|sensor's end"),
    "resampled twice": (resampled, "msc", r"straight lines|interpolat|resampled|repeat"),
    "time in ms": (_each("time in ms", _milliseconds), "msc", r"millisecond|ms|time"),
    "rows twice": (duplicated, "msc", r"duplicate|twice|repeat a time"),
    "two machines": (two_machines, "msc", r"another machine|one machine|differ.*runs|runs.*differ"),
    "one run of another machine": (one_of_another, "msc", r"another machine|one machine|differ"),
    "a state constant": (state_constant, "ms", r"never change"),
    "a velocity of another run": (state_of_another_run, "msc", r"disagree|another run|as fast|rate"),
    "hidden gaps": (gaps_unmarked, "msc", r"jump"),
}
"""Fault -> what breaks the log, machines (m, s, c) that can have it, words that name it."""
