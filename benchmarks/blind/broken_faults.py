"""What people do to logs: each function breaks a log in one way and says which words would name it.

A log is a list of `Table`s, one a run. A fault takes the log, another machine's log of the same kind, and random
numbers, and returns what was done in words; the tables are changed in place. The last entry of `FAULTS` is a regular
expression that has to be found in what a command says for the fault to count as named.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from loop_machine import Array, product, rotation
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import butter, sosfilt, sosfilt_zi, sosfiltfilt


@dataclass
class Table:
    """One run: times (n,), states (n, nx), inputs (n, nu), further columns by name."""

    t: Array
    x: Array
    u: Array
    extra: dict[str, Array] = field(default_factory=dict)

    def rows(self, keep: NDArray[np.int64]) -> Table:
        self.t, self.x, self.u = self.t[keep], self.x[keep], self.u[keep]
        self.extra = {k: v[keep] for k, v in self.extra.items()}
        return self

    def copy(self) -> Table:
        return Table(self.t, self.x, self.u, self.extra).rows(np.arange(len(self.t)))

    @property
    def flies(self) -> bool:
        return self.x.shape[1] == 13

    @property
    def step(self) -> float:
        """Step of the rows [s]."""
        return float(np.median(np.diff(self.t)))

    def normalise(self) -> None:
        """Make quaternions, where there are any, of length 1 again."""
        if self.flies:
            self.x[:, 6:10] /= np.linalg.norm(self.x[:, 6:10], axis=1, keepdims=True)


Log = list[Table]
Fault = Callable[[Log, Log, np.random.Generator], str]
ATTITUDE = [6, 7, 8, 9]


def _each(change: Callable[[Table], object]) -> Fault:
    """A fault that changes every row alike."""

    def fault(log: Log, other: Log, rng: np.random.Generator) -> str:
        for run in log:
            change(run)
        return "every row"

    return fault


def _states(columns: slice | list[int], made: Callable[[Array], Array]) -> Fault:
    """Columns of the states that are made of all states (n, nx)."""
    return _each(lambda run: run.x.__setitem__((slice(None), columns), made(run.x)))


def _inputs(made: Callable[[Array], Array]) -> Fault:
    """Inputs (n, nu) written in another unit or with another sign."""
    return _each(lambda run: setattr(run, "u", made(run.u)))


def _shifted(
    what: str, flying: list[int], others: list[int], least: float = 0.02, inputs: bool = False
) -> Fault:
    """States, straight between rows, or inputs, which are held, shifted in time by at most 0.15 s."""

    def fault(log: Log, other: Log, rng: np.random.Generator) -> str:
        shift = float(rng.uniform(least, 0.15) * rng.choice([-1, 1]))
        for run in log:
            rows, k = shift / run.step, np.arange(len(run.t))
            at, edge = np.clip(k - rows, 0, len(k) - 1), int(abs(rows)) + 1
            for c in flying if run.flies else others:
                run.x[:, c] = np.interp(at, k, run.x[:, c])
            if inputs:
                run.u = run.u[np.floor(at + 1e-9).astype(int)]
            run.rows(np.arange(edge, len(run.t) - edge))
            if flying == ATTITUDE:
                run.normalise()
        return f"{what} shifted by {1e3 * shift:.0f} ms"

    return fault


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


def motors_swapped(log: Log, other: Log, rng: np.random.Generator) -> str:
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
    k, j = int(rng.integers(len(log))), int(rng.integers(log[0].u.shape[1]))
    log[k].u[:, j] = np.resize(log[(k + 1) % len(log)].u[:, j], len(log[k].u))
    return f"u_{j + 1} of run_{k} is of another run"


def motor_constant(log: Log, other: Log, rng: np.random.Generator) -> str:
    j = int(rng.integers(log[0].u.shape[1]))
    value = float(np.mean([run.u[:, j].mean() for run in log]))
    for run in log:
        run.u[:, j] = np.round(value, 3)
    return f"u_{j + 1} constant"


def length_unit(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Positions, sometimes with their velocities, in mm, cm or ft."""
    factor, flies = float(rng.choice([1000.0, 100.0, 3.28084])), log[0].flies
    both = flies and rng.random() < 0.5
    for run in log:
        run.x[:, : 6 if both else 3 if flies else 1] *= factor
    return f"positions{' and velocities' if both else ''} times {factor:g}"


def angle_deg(log: Log, other: Log, rng: np.random.Generator) -> str:
    """The pole's angle, sometimes with its rate, in degrees."""
    both = rng.random() < 0.5
    for run in log:
        run.x[:, 2 : 4 if both else 3] = np.degrees(run.x[:, 2 : 4 if both else 3])
    return f"theta{' and theta_dot' if both else ''} in degrees"


def one_axis_flipped(log: Log, other: Log, rng: np.random.Generator) -> str:
    k = {13: 3 + int(rng.integers(3)), 2: 1, 4: int(rng.choice([1, 3]))}[log[0].x.shape[1]]
    for run in log:
        run.x[:, k] *= -1.0
    return f"state {k} with the other sign"


def smoothed(log: Log, other: Log, rng: np.random.Generator) -> str:
    """All states smoothed, by one of four smoothers that cut at 2 to 8 Hz."""
    cut, kind = float(np.exp(rng.uniform(np.log(2.0), np.log(8.0)))), int(rng.integers(4))
    for run in log:
        rate = 1.0 / run.step
        sos = butter(4 if kind == 0 else 2, cut, fs=rate, output="sos")
        for k, c in enumerate(run.x.T.copy()):
            if kind < 2:
                run.x[:, k] = sosfiltfilt(sos, c)
            elif kind == 2:
                run.x[:, k] = gaussian_filter1d(c, 0.187 * rate / cut, mode="nearest")
            else:
                run.x[:, k] = sosfilt(sos, c, zi=sosfilt_zi(sos) * c[0])[0]
        run.normalise()
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
        run.normalise()
    return f"every {step}th row, straight lines between"


def duplicated(log: Log, other: Log, rng: np.random.Generator) -> str:
    for run in log:
        twice = rng.choice(len(run.t), len(run.t) // 20, replace=False)
        run.rows(np.sort(np.concatenate([np.arange(len(run.t)), twice])))
    return "5 % of the rows twice"


def two_machines(log: Log, other: Log, rng: np.random.Generator) -> str:
    log[len(log) // 2 :] = [run.copy() for run in other[len(log) // 2 :]]
    return "half of the runs are of another machine"


def one_of_another(log: Log, other: Log, rng: np.random.Generator) -> str:
    k = int(rng.integers(len(log)))
    log[k] = other[k].copy()
    return f"run_{k} is of another machine"


def state_constant(log: Log, other: Log, rng: np.random.Generator) -> str:
    k = int(rng.integers(6)) if log[0].flies else 1
    for run in log:
        run.x[:, k] = run.x[0, k]
    return f"state {k} constant"


def state_of_another_run(log: Log, other: Log, rng: np.random.Generator) -> str:
    k = int(rng.integers(len(log)))
    c = 3 + int(rng.integers(3)) if log[0].flies else 1
    log[k].x[:, c] = np.resize(log[(k + 1) % len(log)].x[:, c], len(log[k].x))
    return f"state {c} of run_{k} is of another run"


def gaps_unmarked(log: Log, other: Log, rng: np.random.Generator) -> str:
    """Half a second to a second lost, three times a run, and the clock goes on as if nothing were."""
    for run in log:
        dt, first, keep = run.step, run.t[0], np.ones(len(run.t), dtype=bool)
        for at in rng.uniform(0.1, 0.85, 3) * len(run.t):
            keep[int(at) : int(at + rng.uniform(0.5, 1.0) / dt)] = False
        run.rows(np.flatnonzero(keep))
        run.t = first + dt * np.arange(len(run.t))
    return "three hidden gaps a run"


def quaternions_flip(log: Log, other: Log, rng: np.random.Generator) -> str:
    """The signs of the quaternion change at random rows."""
    for run in log:
        flips = np.cumsum(rng.random(len(run.t)) < 0.002) % 2
        flips[0] = 0
        flips[len(flips) // 2] = 1
        run.x[:, 6:10] *= np.where(flips, -1.0, 1.0)[:, None]
    return "signs of the quaternion flip"


def _in_the_body(x: Array) -> Array:
    """Velocities (n, 3) along the body's axes."""
    return np.einsum("bji,bj->bi", rotation(x[:, 6:10]), x[:, 3:6])


def _turned(x: Array) -> Array:
    """Positions and velocities (n, 6) turned by 90 deg against the attitude."""
    return x[:, [1, 0, 2, 4, 3, 5]] * [-1, 1, 1, -1, 1, 1]


_WORLD = r"axes|frame|NED|ENU"
FAULTS: dict[str, tuple[Fault, str, str]] = {
    "two motors swapped": (motors_swapped, "m", r"order of the (inputs|motors)|u_\d.*(swap|exchang|order)"),
    "motors in another order": (motors_rotated, "m", r"order of the (inputs|motors)|u_\d.*(swap|order)"),
    "NED and FRD": (_each(_ned_frd), "m", r"NED|FRD"),
    "NED positions, ENU attitude": (_states(slice(0, 6), _ned), "m", _WORLD),
    "height downwards": (
        _states([2, 5], lambda x: -x[:, [2, 5]]),
        "m",
        r"NED|downwards|sign of '?p_z|p_z.*sign|axes",
    ),
    "rates in FRD": (_states([11, 12], lambda x: -x[:, 11:13]), "m", r"FRD|sign.*w_y|w_y.*sign|rates"),
    "velocity in the body": (_states(slice(3, 6), _in_the_body), "m", r"body's axes"),
    "world turned by 90 deg": (_states(slice(0, 6), _turned), "m", _WORLD),
    "quaternion xyzw": (_states(ATTITUDE, lambda x: x[:, [7, 8, 9, 6]]), "m", r"scalar last"),
    "quaternion conjugate": (_states([7, 8, 9], lambda x: -x[:, 7:10]), "m", r"world into the body"),
    "rates in deg/s": (_states([10, 11, 12], lambda x: np.degrees(x[:, 10:13])), "m", r"deg"),
    "inputs in percent": (_inputs(lambda u: 100.0 * u), "m", r"percent"),
    "inputs as pulse widths": (_inputs(lambda u: np.round(1000.0 + 1000.0 * u)), "m", r"pulse width"),
    "inputs in [-1, 1]": (_inputs(lambda u: 2.0 * u - 1.0), "m", r"-1|expected 0 to 1"),
    "a motor of another run": (motor_of_another_run, "m", r"u_\d|another machine|run_\d"),
    "a motor constant": (motor_constant, "m", r"never change"),
    "signs of the quaternion": (quaternions_flip, "m", r"sign"),
    "unit of length": (length_unit, "msc", r"unit|metre|mm|ft|feet|SI"),
    "angle in degrees": (angle_deg, "c", r"deg"),
    "angle from hanging": (_states([2], lambda x: x[:, [2]] - np.pi), "c", r"pi more|other side"),
    "angle wrapped": (_states([2], lambda x: np.mod(x[:, [2]] + np.pi, 2 * np.pi) - np.pi), "c", r"wrap"),
    "force flipped": (_inputs(lambda u: -u), "sc", r"opposite sign|sign of .?.?force"),
    "a velocity flipped": (one_axis_flipped, "msc", r"sign|disagree|times as fast"),
    "positions shifted": (_shifted("positions", [0, 1, 2], [0]), "msc", r"late|shift"),
    "attitude shifted": (_shifted("attitude", ATTITUDE, [2]), "mc", r"late|shift"),
    "rates shifted": (_shifted("rates", [10, 11, 12], [3]), "mc", r"late|shift"),
    "attitude and rates shifted": (
        _shifted("attitude and rates", list(range(6, 13)), [2, 3]),
        "mc",
        r"late|shift|early",
    ),
    # beyond what a machine does by itself
    "inputs shifted": (_shifted("inputs", [], [], 0.06, inputs=True), "msc", r"late|shift|early"),
    "states smoothed": (smoothed, "msc", r"smooth|went through"),
    "a sensor clipped": (clipped, "msc", r"clip|sensor's end"),
    "resampled twice": (resampled, "msc", r"straight lines|interpolat|resampled|repeat"),
    "time in ms": (_each(lambda run: setattr(run, "t", run.t * 1e3)), "msc", r"millisecond|ms|time"),
    "rows twice": (duplicated, "msc", r"duplicate|twice|repeat a time"),
    "two machines": (two_machines, "msc", r"another machine|one machine|differ.*runs|runs.*differ"),
    "one run of another machine": (one_of_another, "msc", r"another machine|one machine|differ"),
    "a state constant": (state_constant, "ms", r"never change"),
    "a velocity of another run": (state_of_another_run, "msc", r"disagree|another run|as fast|rate"),
    "hidden gaps": (gaps_unmarked, "msc", r"jump"),
}
"""Fault -> what breaks the log, machines (m, s, c) that can have it, words that name it."""
