"""Whether a mapping says the truth: the run that it makes against kinematics and gravity, in words.

The check looks for another interpretation of the same columns whose residual is a tenth of the mapping's; a unit, an
order of columns, axes. Nothing here knows the machine beyond that its thrust holds it up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations, product
from math import pi

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.mapping.mapping import ColumnEntry, LogMapping
from nsde_torch.data.quaternion import attitude_between, conjugate, increments, rotate
from nsde_torch.data.raw import RawRun
from nsde_torch.data.streams import SECONDS
from nsde_torch.data.system_info import SystemInfo, derivative_columns, rate_columns, rate_pairs

# What kinematics and gravity say of conventions, before any physics of a machine is known.
#
#     log(q(t)^-1 q(t + T)) = int omega dt,    p(t + T) - p(t) = int v dt         (T = 0.25 s)
#     a_xy = g M b_xy          a the acceleration, b the body's third axis in the world
#
# A multirotor of any weight accelerates in the direction in which its thrust is tilted. `M` is the identity if the
# body's third axis is that of the thrust, its negative if it points down, and another matrix if the axes of positions
# are not those of the attitude. Whether the world's third axis is up, too, is seen from the sign of `b_z`.

INTERVAL_S = 0.25
SOUND_ATTITUDE, SOUND_VELOCITY = 0.25, 0.05  # shares of the motion that a sound log leaves at most
NOISY_VELOCITY = 5 * SOUND_VELOCITY
"""The share up to which noise explains what velocities leave; an interpretation that leaves more is no remedy."""
_FEWEST = 20  # intervals
_TILT_S = 0.3
_LEAST_TILT = 0.01  # root mean square of the tilt [rad] from which on it says something
_LEFT, _CLEAR = 0.5, 0.6  # share that the right `M` leaves at most, and of that of the next


@dataclass(frozen=True)
class AttitudeWay:
    """A way to read a quaternion and rates: the order of its columns, what it turns, the rates' unit and axes."""

    order: str = "wxyz"
    turns: str = "body to world"
    unit: str = "rad/s"
    signs: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class VelocityWay:
    """A way to read a velocity: along which axes, in what order and with what signs."""

    axes: str
    places: tuple[int, int, int] = (0, 1, 2)
    signs: tuple[float, float, float] = (1.0, 1.0, 1.0)


def read_attitude(q: Array, way: AttitudeWay) -> Array:
    """A quaternion as `w x y z`, body to world."""
    q = q[:, [3, 0, 1, 2]] if way.order == "xyzw" else q
    return conjugate(q) if way.turns == "world to body" else q


TURNS = ("body to world", "world to body")


def attitude_ways(order: str | None, unit: str | None) -> list[AttitudeWay]:
    """Ways that names leave open, the usual first."""
    orders = (order,) if order else ("wxyz", "xyzw")
    units = (unit,) if unit else ("rad/s", "deg/s")
    signs = ((1.0, 1.0, 1.0), (1.0, -1.0, -1.0))
    return [AttitudeWay(*way) for way in product(orders, TURNS, units, signs)]


VELOCITY_WAYS = (
    VelocityWay("world"),
    VelocityWay("body"),
    VelocityWay("body", signs=(1.0, -1.0, -1.0)),
    VelocityWay("world", signs=(1.0, 1.0, -1.0)),
    VelocityWay("world", (1, 0, 2), (1.0, 1.0, -1.0)),
)
"""Ways to read a velocity, the usual first."""


def attitude_left(t: Array, q: Array, w: Array, way: AttitudeWay) -> float:
    """Share of the turning over 0.25 s that rates leave; nan of too little motion.

    Quaternion (n, 4) and rates (n, 3) are as logged, and read in that way; times (n,) are in seconds.
    """
    size = np.pi / 180.0 if way.unit == "deg/s" else 1.0
    turned = increments(read_attitude(q, way))
    rate = size * w * np.array(way.signs)
    return motion_left(t, turned, rate)


def velocity_left(t: Array, q: Array | None, p: Array, v: Array, way: VelocityWay) -> float:
    """Share of the movement over 0.25 s that a velocity leaves; nan of too little motion.

    The velocity (n, 3) is as logged, and read in that way; the attitude `w x y z` (n, 4), body to world, is needed for
    one along the body's axes. Times (n,) are in seconds.
    """
    rate = v[:, list(way.places)] * np.array(way.signs)
    if way.axes == "body":
        if q is None:
            return float("nan")
        rate = rotate(q, rate)
    return motion_left(t, np.diff(p, axis=0), rate)


def motion_left(t: Array, change: Array, rate: Array) -> float:
    """Share of changes from row to row (n - 1, k), over 0.25 s, that rates (n, k) leave; nan of too little motion."""
    dt, rate = np.diff(t), 0.5 * (rate[1:] + rate[:-1])
    usual = float(np.median(dt))
    length = max(1, round(INTERVAL_S / usual))
    good = np.isfinite(change).all(axis=1) & np.isfinite(rate).all(axis=1) & (dt < 2.5 * usual)
    n = len(dt) // length
    if n < _FEWEST:
        return float("nan")
    whole = good[: n * length].reshape(n, length).all(axis=1)
    if whole.sum() < _FEWEST:
        return float("nan")
    parts = (np.where(good[:, None], values, 0.0)[: n * length] for values in (change, rate * dt[:, None]))
    moved, told = (part.reshape(n, length, -1).sum(axis=1)[whole] for part in parts)
    bias = (moved - told).mean(axis=0)
    told = told + bias * (np.abs(bias) < 0.2 * moved.std(axis=0))
    size = float(np.square(moved - moved.mean(axis=0)).sum())
    rounding = 1e-18 * float(np.square(moved).sum())
    return float(np.square(moved - told).sum()) / size if size > rounding else float("nan")


LEANS: dict[str, tuple[tuple[int, int], tuple[int, int]]] = {
    "up": ((1, 0), (0, 1)),
    "down": ((-1, 0), (0, -1)),
    "turned by 90 deg": ((0, -1), (1, 0)),
    "turned by -90 deg": ((0, 1), (-1, 0)),
    "exchanged": ((0, 1), (1, 0)),
    "exchanged and reversed": ((0, -1), (-1, 0)),
    "reversed in x": ((-1, 0), (0, 1)),
    "reversed in y": ((1, 0), (0, -1)),
}
"""What `M` may be: third axes up or down, or horizontal axes of positions that are not those of the attitude."""


@dataclass(frozen=True)
class Lean:
    """How horizontal acceleration follows the tilt of the body's third axis."""

    left: dict[str, float]
    """Share of the horizontal acceleration that each `M` of `LEANS` leaves, its size free."""
    up: float  # mean of the third component of the body's third axis in the world: 1 level, -1 upside down

    @property
    def way(self) -> str | None:
        """Key of `LEANS` that explains most; None where none explains much, or two do."""
        first, second = sorted(self.left, key=lambda name: self.left[name])[:2]
        clear = self.left[first] < _LEFT and self.left[first] < _CLEAR * self.left[second]
        return first if clear else None


def lean(t: Array, q: Array, p: Array) -> Lean | None:
    """`M` of a flight, by least squares on means over 0.3 s; None where there is too little of it.

    Times (n,) are in seconds, attitudes `w x y z` (n, 4) body to world, positions (n, 3).
    """
    good = np.isfinite(q).all(axis=1) & np.isfinite(p).all(axis=1)
    t, q, p = t[good], q[good], p[good]
    if len(t) < 2 or t[-1] - t[0] < 10 * _TILT_S:
        return None
    step = _TILT_S / 4
    if t[-1] - t[0] > 2 * step * len(t):  # too few rows to say anything, or times of no clock
        return None
    grid = np.arange(t[0], t[-1], step)
    third = rotate(q, np.broadcast_to([0.0, 0.0, 1.0], (len(q), 3)))
    edges = np.searchsorted(t, np.append(grid, t[-1]))
    counts = np.diff(edges)
    if (counts == 0).mean() > 0.2:
        return None
    keep = counts > 0
    starts = edges[:-1][keep]
    b = np.add.reduceat(third, starts, axis=0) / counts[keep][:, None]
    x = np.add.reduceat(p, starts, axis=0) / counts[keep][:, None]
    k = 4  # a second difference over twice 0.3 s, and the mean of the tilt with the same triangle
    if len(x) < 4 * k:
        return None
    even = np.diff(np.flatnonzero(keep)) == 1
    a = (x[2 * k :] - 2.0 * x[k:-k] + x[: -2 * k]) / (k * step) ** 2
    triangle = np.concatenate([np.arange(1, k + 1), np.arange(k - 1, 0, -1)]) / k**2
    leaning = np.stack([np.convolve(b[:, j], triangle, mode="valid") for j in range(3)], axis=1)
    leaning = leaning[1 : 1 + len(a)]
    broken = np.convolve(~even, np.ones(2 * k), mode="valid")[: len(a)] > 0
    a, leaning = a[: len(leaning)][~broken[: len(leaning)]], leaning[~broken[: len(leaning)]]
    if len(a) < 40 or float(np.sqrt(np.square(leaning[:, :2]).mean())) < _LEAST_TILT:
        return None
    plane = leaning[:, :2] - leaning[:, :2].mean(axis=0)
    flat = a[:, :2] - a[:, :2].mean(axis=0)
    whole = max(float(np.square(flat).sum()), 1e-300)
    left = {}
    for name, matrix in LEANS.items():
        told = plane @ np.array(matrix, dtype=float).T
        size = max(float((flat * told).sum()) / max(float(np.square(told).sum()), 1e-300), 0.0)
        left[name] = float(np.square(flat - size * told).sum()) / whole
    return Lean(left, float(np.nanmean(third[:, 2])))


def best(values: Sequence[float]) -> int | None:
    """Index of the smallest value; of some within a factor of 1.5 the first. None where all are nan."""
    known = [v for v in values if np.isfinite(v)]
    if not known:
        return None
    least = max(min(known), 1e-9)
    return next(k for k, v in enumerate(values) if np.isfinite(v) and v <= 1.5 * least)


# What columns hold that are not what they are read as: times in another unit, columns exchanged, a unit or a
# sign.
#
#     p(t + T) - p(t) = int v dt         (T = 0.25 s)
#
# holds for a position and its rate. Where it fails as the columns are read and holds in another interpretation, that
# one is named. In a sound log it holds as it is, and nothing else is looked at.

BETTER = 10.0  # factor by which the residual of another interpretation of the columns must be smaller
_SLOW_S, _FAST_S, _FASTEST_S = 0.5, 2e-5, 1e-5
"""Steps beyond which times are taken for another unit, and the shortest that they then may have [s]."""
_ALIKE = 2.0  # times the least that is left, up to which two interpretations are equally good
_LENGTHS = (("mm", 1e-3), ("cm", 1e-2), ("ft", 0.3048))


@dataclass(frozen=True)
class Misread:
    """Another interpretation of columns, in which they agree."""

    words: str  # what would be so
    remedy: str  # what to do
    left: float  # share of the motion that is left then


def percent(share: float) -> str:
    """A share of a motion; a large one as a multiple."""
    return f"{share:.1%}" if share < 10.0 else f"{share:.2g} times all"


def pair_left(t: Array, p: Array, v: Array) -> float:
    """Share of the movement of one position (n,) over 0.25 s that its rate (n,) leaves; nan of too little motion."""
    return motion_left(t, np.diff(p)[:, None], v[:, None])


def _times(system: SystemInfo, run: RawRun, mapping: LogMapping) -> LogCheck | None:
    """Another unit of the times, in which all positions follow their rates; None where there is none.

    Only steps that no log of a moving machine has are looked at: a rate in mm/s does the same to one pair of columns.
    Without a mapping the columns are the package's own.
    """
    step = float(np.median(np.diff(run.t))) if len(run.t) > 1 else 0.0
    if not (step >= _SLOW_S or 0 < step < _FAST_S) or _all_sound(system, run, 1.0):
        return None
    clock, now = mapping.time, mapping.time.unit or "s"
    row_s = _row_s(system, run) if step == SECONDS[now] else None
    if row_s is not None and _all_sound(system, run, row_s / step):
        text = f"the times count rows; with rows {row_s:.3g} s apart they agree with all rates."
        entry = f"`time: {{rate: {1.0 / row_s:.4g}}}`"
        remedy = f"write times in seconds, or read the files as tables, with {entry} in a mapping"
        return LogCheck("time", False, text, remedy)
    for unit, seconds in SECONDS.items():
        size = seconds / SECONDS[now]
        if unit != now and _FASTEST_S <= size * step < _SLOW_S and _all_sound(system, run, size):
            entry = f"`time: {{from: {clock.source or 't'}, unit: {unit}}}`"
            remedy = (
                f"write {entry} in the mapping"
                if clock.source
                else f"write `t` in seconds, or read the files as tables, with {entry} in a mapping "
                "(`nsde inspect LOG kind=table` writes one)"
            )
            text = f"rows are {step:.4g} s apart as the times are read; in {unit} they agree with all rates."
            return LogCheck("time", False, text, remedy)
    return None


def _row_s(system: SystemInfo, run: RawRun) -> float | None:
    """Seconds from row to row, as positions and the sums of their rates say, where times are numbers of rows."""
    if np.ptp(np.diff(run.t)) > 0:
        return None
    for i, j in rate_pairs(system):
        good = np.isfinite(run.x[:, [i, j]]).all(axis=1)
        position, rate = run.x[good, i], run.x[good, j]
        summed = np.cumsum(rate) - 0.5 * rate
        summed -= summed.mean()
        size = float(summed @ position) / max(float(summed @ summed), 1e-300)
        if size > 0:
            return size
    return None


def _all_sound(system: SystemInfo, run: RawRun, size: float) -> bool:
    """Whether all that moves follows its rate, with times multiplied by `size`."""
    t = size * run.t
    left = [(pair_left(t, run.x[:, i], run.x[:, j]), NOISY_VELOCITY) for i, j in rate_pairs(system)]
    rates = rate_columns(system)
    if system.quaternion is not None and rates is not None:
        turning = attitude_left(t, run.x[:, system.quaternion], run.x[:, rates], AttitudeWay())
        left.append((turning, SOUND_ATTITUDE))
    known = [(share, most) for share, most in left if np.isfinite(share)]
    return bool(known) and all(share <= most for share, most in known)


def exchanged(system: SystemInfo, run: RawRun) -> list[list[tuple[str, str]]]:
    """Columns that agree with all others once two are exchanged, and only then; each with what does the same."""
    names = system.state_names
    pairs = [(names[i], names[j]) for i, j in rate_pairs(system)]
    columns = {name: run.x[:, names.index(name)] for pair in pairs for name in pair}
    free = system.quaternion is None  # axes of one vector are exchanged by a frame, of which others speak
    if free and len(run.u) == len(run.t):
        columns |= zip(system.input_names, run.u.T, strict=True)

    def left(pair: tuple[str, str], moved: Mapping[str, str]) -> float:
        p, v = (columns[moved.get(name, name)] for name in pair)
        return pair_left(run.t, p, v)

    own = {pair: left(pair, {}) for pair in pairs}
    if not any(share > SOUND_VELOCITY for share in own.values()):
        return []
    out: dict[tuple[tuple[str, str], ...], list[tuple[str, str]]] = {}
    for a, b in combinations(columns, 2) if free else pairs:
        touched = [pair for pair in pairs if {a, b} & set(pair)]
        worst = max((own[pair] for pair in touched), default=0.0)
        if not worst > SOUND_VELOCITY:
            continue
        most = min(NOISY_VELOCITY, worst / BETTER)
        if all(left(pair, {a: b, b: a}) <= most for pair in touched):
            out.setdefault(tuple(touched), []).append((a, b))
    return list(out.values())


def rate_misread(system: SystemInfo, run: RawRun, i: int, j: int, mapping: LogMapping) -> list[Misread]:
    """Units and signs of a position (column i) or its rate (j) in which they agree, best first; none in a sound log.

    A unit that the mapping reads wrongly does what another unit of the other column does.
    """
    p, v = run.x[:, i], run.x[:, j]
    own = pair_left(run.t, p, v)
    if not own > SOUND_VELOCITY:
        return []
    position, rate, unit = system.state_names[i], system.state_names[j], system.state_units[i]
    tried = [Misread(f"{rate} has the opposite sign", f"change the sign of {rate}", pair_left(run.t, p, -v))]
    small = (("deg", pi / 180.0), ("mrad", 1e-3)) if unit == "rad" else _LENGTHS
    for name, size in small:
        for column, its, factor in ((rate, f"{name}/s", size), (position, name, 1.0 / size)):
            remedy = f"multiply {column} by {size:.4g}, or write `unit: {its}` in its entry of a mapping"
            left = pair_left(run.t, p, factor * v)
            other, read = (position, name) if column == rate else (rate, f"{name}/s")
            entry = mapping.columns.get(other)
            if entry is not None and entry.unit == read:
                no = f"take `unit: {read}` out of its entry of the mapping"
                tried.append(Misread(f"{other} has another unit than the {read} of the mapping", no, left))
            tried.append(Misread(f"{column} is in {its}", remedy, left))
    if unit == "rad":
        size = 2.0 * pi / 60.0
        remedy = f"multiply {rate} by {size:.4g}, or write `unit: rpm` in its entry of a mapping"
        tried.append(Misread(f"{rate} is in rpm", remedy, pair_left(run.t, p, size * v)))
    most = min(NOISY_VELOCITY, own / BETTER)
    good = sorted((one for one in tried if one.left <= most), key=lambda one: one.left)
    return [one for one in good if one.left <= _ALIKE * good[0].left]


LEAN = "lean and acceleration"  # name of the check of gravity, where the others are of kinematics alone
SUSPECT = "columns"  # kind of the finding of a check that speaks against the columns and does not refuse them
ATTITUDE, VELOCITY = "attitude and rates", "position and velocity"
"""Names of the checks of the vectors of a vehicle."""
_MOST = 60_000  # rows
_SPIKE = 20.0  # such a multiple of the largest usual changes between rows is no movement
_FEW = 200  # rows, of fewer one spike is a usual change
_TURN = 6.3  # range of an angle that was logged within one turn [rad]
_SIZES = (1e-3, 1e-2, 0.3048, 1.0 / 0.3048, 1e2, 1e3)  # factors that a forgotten unit would be
_ATTITUDE_AS = "write the quaternion as w x y z, body to world, and rates in rad/s about FLU axes"
_VELOCITY_AS = "write velocities in m/s along the axes of the positions (ENU), in their order"
_LEAN_WORDS = {
    "down": "positions are turned by 180 deg about the vertical against the attitude, or the body's third axis points "
    "down: check `frames` (NED for ENU, FRD for FLU)",
    "turned by 90 deg": "positions are turned by 90 deg about the vertical against the attitude",
    "turned by -90 deg": "positions are turned by -90 deg about the vertical against the attitude",
    "exchanged": "east and north of positions are exchanged against the attitude: one of them is NED and the other ENU",
    "exchanged and reversed": "east and north of positions are exchanged and reversed against the attitude",
    "reversed in x": "the first axis of positions has the opposite sign of the attitude's",
    "reversed in y": "the second axis of positions has the opposite sign of the attitude's (a left-handed frame)",
}


@dataclass(frozen=True)
class LogCheck:
    """One check of a mapping."""

    name: str  # what was checked
    passed: bool | None  # None where the log does not decide
    text: str  # the result, one sentence
    remedy: str = ""  # what to mend, in the imperative; empty where nothing speaks against the columns

    @property
    def doubts(self) -> bool:
        """Whether it speaks against the columns as they are read."""
        return self.passed is False or bool(self.remedy)


def together(runs: Sequence[RawRun]) -> RawRun:
    """The first run, or of short ones so many, with a pause after each, that they hold intervals enough."""
    most = 2.0 * _FEWEST * INTERVAL_S
    parts, starts, end = [], [], 0.0
    for run in runs:
        n = min(len(run.t), len(run.u))
        t = np.sort(run.t[:n])
        if n > 1 and np.isfinite(t).all():
            parts.append((run.t[:n] - t[0] + end, run.x[:n], run.u[:n]))
            starts.append(run)
            end += t[-1] - t[0] + 10.0 * float(np.median(np.diff(t)))
        if end > most:
            break
    if len(parts) < 2:
        return runs[0]
    t, x, u = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return RawRun("short runs together", t, x, u, source=runs[0].source)


# overflows are of numbers that no sensor says: the checks of all data refuse them
@np.errstate(over="ignore", invalid="ignore")
def checks(system: SystemInfo, run: RawRun, mapping: LogMapping | None = None) -> list[LogCheck]:
    """What kinematics and gravity say of a run: `nsde_torch.read` and `nsde inspect` ask the same.

    Rows are in the order of time; of those with one time the first is looked at. With the mapping that made the run its
    columns can be read otherwise; without one they follow the package's own conventions.
    """
    if len(run.t) > _MOST:  # the middle says enough, in a tenth of the time
        first = (len(run.t) - _MOST) // 2
        rows = slice(first, first + _MOST)
        run = RawRun(run.name, run.t[rows], run.x[rows], run.u[rows])
    own = np.diff(run.t, prepend=-np.inf) > 0
    run = RawRun(run.name, run.t[own], _without_spikes(_unwrapped(system, run.x[own])), run.u[own])
    mapping = LogMapping({}) if mapping is None else mapping
    times = _times(system, run, mapping)
    if times is not None:
        return [times]
    swapped = exchanged(system, run)
    out = [_exchanged(system, run, ways, mapping) for ways in swapped]
    moved = {name for ways in swapped for pair in ways for name in pair}
    q, rates = system.quaternion, rate_columns(system)
    attitude = None if q is None else run.x[:, q]
    if q is not None and attitude is not None and rates is not None:
        out.append(_attitude(run.t, attitude, run.x[:, rates], system.state_names[q], mapping))
    for group, (i, j) in derivative_columns(system).items():
        if not np.isfinite(run.x[:, j]).any():
            continue
        if len(i) == 3 and attitude is not None and "(world" in group:
            if moved & {system.state_names[k] for k in (*i, *j)}:
                continue
            names = [system.state_names[k] for k in j]
            out.append(_velocity(run.t, attitude, run.x[:, i], run.x[:, j], names))
            # else the tilt shows the same fault once more
            if all(check.passed is not False for check in out):
                out.append(_lean(run.t, attitude, run.x[:, i]))
        else:
            for a, b in zip(i, j, strict=True):
                if not moved & {system.state_names[a], system.state_names[b]}:
                    out.append(_axis(system, run, a, b, mapping))
    return out


def _without_spikes(x: Array) -> Array:
    """States (n, nx) with single values that are off by far set to a neighbour's: they say nothing of the columns."""
    if len(x) < _FEW:
        return x
    neighbours = np.sort(np.stack((x[:-2], x[1:-1], x[2:])), axis=0)[1]
    change = np.quantile(np.abs(np.diff(np.nan_to_num(x), axis=0)), 0.99, axis=0)
    off = (np.abs(x[1:-1] - neighbours) > _SPIKE * change) & (change > 0.0)
    x[1:-1][off] = neighbours[off]
    return x


def _unwrapped(system: SystemInfo, x: Array) -> Array:
    """States with angles that stay within a turn made continuous, as reading makes them."""
    x = np.array(x)
    for i, _ in rate_pairs(system):
        good = np.isfinite(x[:, i])
        if system.state_units[i] == "rad" and good.any() and np.ptp(x[good, i]) < _TURN:
            x[good, i] = np.unwrap(x[good, i])
    return x


def _attitude(t: Array, q: Array, w: Array, names: Sequence[str], mapping: LogMapping) -> LogCheck:
    called = (names[0].partition("_")[0], *names)
    entry = next((e for name, e in mapping.columns.items() if name in called), ColumnEntry(()))
    logged, (ned, frd) = AttitudeWay(entry.order or "wxyz", entry.turns or TURNS[0]), mapping.axes_of(entry)
    raw = attitude_between(q, ned=ned, frd=frd)  # twice is once too often by a sign at most
    raw = conjugate(raw) if logged.turns == "world to body" else raw
    raw = raw[:, [1, 2, 3, 0]] if logged.order == "xyzw" else raw
    own = attitude_left(t, q, w, AttitudeWay())
    if not np.isfinite(own):
        return LogCheck(ATTITUDE, None, "too little turning to compare the attitude with the rates.")
    told = f"the rates leave {own:.1%} of the attitude's turning over 0.25 s"
    if own <= SOUND_ATTITUDE:
        return LogCheck(ATTITUDE, True, f"{told}.")
    best, words = own, ""
    sizes = ((1.0, ""), (np.pi / 180.0, "deg/s"), (180.0 / np.pi, "rad/s"))
    orders = (logged.order,) if len(entry.source) == 3 else ("wxyz", "xyzw")
    for order, turns in product(orders, TURNS):
        other = attitude_between(read_attitude(raw, AttitudeWay(order, turns)), ned=ned, frd=frd)
        for (factor, unit), sign in product(sizes, (1.0, -1.0)):
            left = attitude_left(t, other, factor * w, AttitudeWay(signs=(1.0, sign, sign)))
            if left < best:
                best, words = left, _attitude_words(logged, order, turns, unit, sign)
    if BETTER * best < own:
        text = f"the rates leave {own:.0%} of the attitude's turning, and {best:.1%} if {words}."
        return LogCheck(ATTITUDE, False, text, f"{_ATTITUDE_AS}, or say in a mapping that {words}")
    text = f"{told}, whatever their order, direction and unit: of another body or time."
    remedy = "look at the attitude and the rates: one is of another body or time"
    return LogCheck(ATTITUDE, None, text, remedy)


def _attitude_words(logged: AttitudeWay, order: str, turns: str, unit: str, sign: float) -> str:
    words = []
    if order != logged.order:
        place = "first" if order == "wxyz" else "last"
        words.append(f"the quaternion has its scalar {place} (`order: {order}`)")
    if turns != logged.turns:
        first, _, last = turns.partition(" to ")
        words.append(f"it turns the {first} into the {last} (`turns: {turns}`)")
    if unit:
        words.append(f"the rates are in {unit} (`unit: {unit}`)")
    if sign < 0:
        words.append("the rates are those of the other body axes (FRD for FLU: `body` of one of them)")
    return " and ".join(words)


def _velocity(t: Array, q: Array, p: Array, v: Array, names: Sequence[str]) -> LogCheck:
    orders = (VelocityWay("world", (i, j, k)) for i, j, k in permutations(range(3)) if i > 0 or j > 1)
    ways = [*VELOCITY_WAYS, *orders]
    left = [velocity_left(t, q, p, v, way) for way in ways]
    sizes = [velocity_left(t, q, p, factor * v, ways[0]) for factor in _SIZES]
    if not np.isfinite(left[0]):
        return LogCheck(VELOCITY, None, "too little movement to compare position and velocity.")
    k, size = int(np.nanargmin(left)), int(np.nanargmin(sizes))
    other = min(left[k], sizes[size])
    if left[0] > SOUND_VELOCITY and BETTER * other < left[0]:
        by = f"{_SIZES[size]:g} times as large: one of the two has another unit (mm or ms, say)"
        words = _velocity_words(ways[k], names) if left[k] <= sizes[size] else f"they are {by}"
        text = f"velocities leave {percent(left[0])} of the movement, and {other:.1%} if {words}."
        return LogCheck(VELOCITY, False, text, f"{_VELOCITY_AS}, or say in a mapping that {words}")
    if left[0] <= NOISY_VELOCITY:
        return LogCheck(VELOCITY, True, f"velocities leave {left[0]:.1%} of the movement over 0.25 s.")
    if _noise_alone(t, p, left[0]):
        text = "too little movement beside the noise to compare position and velocity."
        return LogCheck(VELOCITY, None, text)
    text = (
        f"velocities leave {percent(left[0])} of the movement over 0.25 s, and no other reading of these "
        "columns does much better: another unit, time or body."
    )
    remedy = "look at the positions and the velocities: one is of another unit, time or body"
    return LogCheck(VELOCITY, None, text, remedy)


def _lean(t: Array, q: Array, p: Array) -> LogCheck:
    found = lean(t, q, p)
    if found is None or found.way is None:
        text = "the log leans too little, or too alike, to tell the axes of attitude and positions."
        return LogCheck(LEAN, None, text)
    rest = f"{found.left['up']:.0%} of the acceleration left"
    if found.way == "up" and found.up > 0:
        return LogCheck(LEAN, True, f"the machine speeds up where its thrust leans ({rest}).")
    words = _LEAN_WORDS.get(found.way, "the world's third axis points down: check `frames.world`")
    text = f"the machine does not speed up where its thrust leans ({rest}): {words}."
    return LogCheck(LEAN, False, text, f"write all states in ENU and FLU: {words}")


def _velocity_words(way: VelocityWay, names: Sequence[str]) -> str:
    if way.axes == "body":
        body = "" if way.signs[1] > 0 else " of the other handedness, FRD for FLU"
        return f"they are along the body's axes{body} (`axes: body`)"
    if way.signs == (1.0, 1.0, 1.0):
        return f"the columns {' '.join(names[k] for k in way.places)} are {' '.join(names)}"
    if way.places == (1, 0, 2):
        return "they are NED and the positions ENU, or the other way round (`world` of one of them)"
    return "their third axis has the opposite sign of the position's (one up, one down)"


def _axis(system: SystemInfo, run: RawRun, i: int, j: int, mapping: LogMapping) -> LogCheck:
    position, rate = system.state_names[i], system.state_names[j]
    names = f"{position} and {rate}"
    own = pair_left(run.t, run.x[:, i], run.x[:, j])
    if not np.isfinite(own):
        return LogCheck(names, None, f"too little movement to compare {names}.")
    others = rate_misread(system, run, i, j, mapping)
    if others:
        words, remedy = _alternatives(others)
        text = f"{rate} leaves {percent(own)} of what {position} moves, and {percent(others[0].left)} if {words}."
        return LogCheck(names, False, text, remedy)
    text = f"{rate} leaves {percent(own)} of what {position} moves over 0.25 s"
    if own <= NOISY_VELOCITY:
        return LogCheck(names, True, f"{text}.")
    if _noise_alone(run.t, run.x[:, i : i + 1], own):
        return LogCheck(names, None, f"too little movement beside the noise to compare {names}.")
    remedy = f"look at {names}: one of them is another column, or of another time or unit"
    return LogCheck(names, None, f"{text}, whatever its sign and unit.", remedy)


def _noise_alone(t: Array, p: Array, left: float) -> bool:
    """Whether what rates leave of positions (n, axes) over 0.25 s is no more than their white noise explains."""
    length = max(1, round(INTERVAL_S / float(np.median(np.diff(t)))))
    moved = np.diff(p[::length], axis=0)
    noise = 1.4826 * np.nanmedian(np.abs(np.diff(p, 5, axis=0)), axis=0) / 252.0**0.5
    share = float(2.0 * np.square(noise).sum() / max(np.nanvar(moved, axis=0).sum(), 1e-300))
    return left <= NOISY_VELOCITY + 2.0 * share


def _exchanged(
    system: SystemInfo, run: RawRun, ways: Sequence[tuple[str, str]], mapping: LogMapping
) -> LogCheck:
    """Two columns that are exchanged, or whatever else makes them agree."""
    a, b = ways[0]
    pairs = [(i, j) for i, j in rate_pairs(system) if {system.state_names[i], system.state_names[j]} & {a, b}]
    i, j = max(pairs, key=lambda pair: pair_left(run.t, run.x[:, pair[0]], run.x[:, pair[1]]))
    position, rate = system.state_names[i], system.state_names[j]
    own = pair_left(run.t, run.x[:, i], run.x[:, j])
    also = rate_misread(system, run, i, j, mapping) if {a, b} == {position, rate} else []
    swaps = [Misread(f"{c} and {d} are exchanged", f"exchange the columns {c} and {d}", 0.0) for c, d in ways]
    words, remedy = _alternatives([*swaps, *also])
    text = f"{rate} leaves {percent(own)} of what {position} moves, and next to nothing if {words}."
    return LogCheck(f"{a} and {b}", False, text, remedy)


def _alternatives(readings: Sequence[Misread]) -> tuple[str, str]:
    """Words and remedies of interpretations that are equally good."""
    return " or ".join(one.words for one in readings), ", or ".join(one.remedy for one in readings)
