"""Whether a mapping says the truth: the run that it makes against kinematics and gravity, in words.

What is looked for is another reading of the same columns that leaves a tenth of what the mapping's leaves; a unit, an
order of columns, axes. Nothing here knows the machine beyond that its thrust holds it up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.frames import attitude_between
from nsde_torch.data.mapping.kinematic import (
    NOISY_VELOCITY,
    SOUND_ATTITUDE,
    SOUND_VELOCITY,
    AttitudeWay,
    VelocityWay,
    attitude_left,
    lean,
    noise_share,
    read_attitude,
    velocity_left,
    velocity_ways,
)
from nsde_torch.data.mapping.mapping import LogMapping
from nsde_torch.data.mapping.misread import (
    BETTER,
    Misread,
    exchanged,
    pair_left,
    percent,
    rate_misread,
    times_misread,
)
from nsde_torch.data.quaternion import conjugate
from nsde_torch.data.raw import RawRun
from nsde_torch.data.system_info import SystemInfo, derivative_columns, rate_columns, rate_pairs

LEAN = "lean and acceleration"
"""Name of the check of gravity, where the others are of kinematics alone."""
SUSPECT = "columns"
"""Kind of the finding of a check that speaks against the columns and does not refuse them."""
ATTITUDE, VELOCITY = VECTORS = ("attitude and rates", "position and velocity")
"""Names of the checks of the vectors of a vehicle."""
_MOST = 60_000  # rows
_SPIKE = 20.0  # such a multiple of the largest usual changes between rows is no movement
_FEW = 200  # rows, of fewer one spike is a usual change
_TURN = 6.3  # range of an angle that was logged within one turn [rad]
_SIZES = (1e-3, 1e-2, 0.3048, 1.0 / 0.3048, 1e2, 1e3)
"""Factors that a forgotten unit would be."""
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
    """One check of a mapping.

    Args:
        name: What was checked.
        passed: True, False, or None where the log does not tell.
        text: The result, one sentence.
        remedy: What to mend, in the imperative; empty where nothing speaks against the columns.
    """

    name: str
    passed: bool | None
    text: str
    remedy: str = ""

    @property
    def doubts(self) -> bool:
        """Whether it speaks against the columns as they are read."""
        return self.passed is False or bool(self.remedy)


@np.errstate(
    over="ignore", invalid="ignore"
)  # of numbers that no sensor says: the checks of all data refuse them
def checks(system: SystemInfo, run: RawRun, mapping: LogMapping | None = None) -> list[LogCheck]:
    """What kinematics and gravity say of a run: `nsde_torch.read` and `nsde inspect` ask the same.

    Args:
        system: The machine.
        run: In the system's units, axes and order, its rows in the order of time; of those with one time the first is
            looked at.
        mapping: What made it, so that its columns can be read otherwise; None: the package's own conventions.
    """
    out: list[LogCheck] = []
    if len(run.t) > _MOST:  # the middle says enough, in a tenth of the time
        first = (len(run.t) - _MOST) // 2
        rows = slice(first, first + _MOST)
        run = RawRun(run.name, run.t[rows], run.x[rows], run.u[rows])
    own = np.diff(run.t, prepend=-np.inf) > 0
    run = RawRun(run.name, run.t[own], _without_spikes(_unwrapped(system, run.x[own])), run.u[own])
    other = times_misread(system, run, mapping)
    if other is not None:
        return [LogCheck("time", False, f"{other.words}.", other.remedy)]
    swapped = exchanged(system, run)
    out += [_exchanged(system, run, ways, mapping) for ways in swapped]
    moved = {name for ways in swapped for pair in ways for name in pair}
    q, rates = system.quaternion, rate_columns(system)
    attitude = None if q is None else run.x[:, q]
    if q is not None and attitude is not None and rates is not None:
        logged = _logged(system.state_names[q], mapping)
        out.append(_attitude(run.t, attitude, run.x[:, rates], logged))
    for group, (i, j) in derivative_columns(system).items():
        if not np.isfinite(run.x[:, j]).any():
            continue
        if len(i) == 3 and attitude is not None and "(world" in group:
            if moved & {system.state_names[k] for k in (*i, *j)}:
                continue
            out += _velocity(run.t, attitude, run.x[:, i], run.x[:, j])
            if not any(
                check.passed is False for check in out
            ):  # else the lean shows the same fault once more
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


@dataclass(frozen=True)
class _Logged:
    """How a mapping says that the attitude was logged."""

    order: str = "wxyz"
    turns: str = "body to world"
    ned: bool = False
    frd: bool = False
    angles: bool = False

    def read(self, q: Array, order: str, turns: str) -> Array:
        """The attitude, had its columns another order and another direction."""
        if (order, turns) == (self.order, self.turns):
            return q
        raw = attitude_between(q, ned=self.ned, frd=self.frd)  # twice is once too often by a sign at most
        raw = conjugate(raw) if self.turns == "world to body" else raw
        raw = raw[:, [1, 2, 3, 0]] if self.order == "xyzw" else raw
        way = AttitudeWay(order, turns, "rad/s", (1.0, 1.0, 1.0))
        return attitude_between(read_attitude(raw, way), ned=self.ned, frd=self.frd)


def _logged(names: Sequence[str], mapping: LogMapping | None) -> _Logged:
    if mapping is None:
        return _Logged()
    entry = next((e for n, e in mapping.columns.items() if n in (names[0].partition("_")[0], *names)), None)
    if entry is None:
        return _Logged()
    world, body = entry.world or mapping.world, entry.body or mapping.body
    return _Logged(
        entry.order or "wxyz",
        entry.turns or "body to world",
        world == "NED",
        body == "FRD",
        len(entry.source) == 3,
    )


def _attitude(t: Array, q: Array, w: Array, logged: _Logged) -> LogCheck:
    plain = AttitudeWay("wxyz", "body to world", "rad/s", (1.0, 1.0, 1.0))
    own = attitude_left(t, q, w, plain)
    if not np.isfinite(own):
        return LogCheck(ATTITUDE, None, "too little turning to compare the attitude with the rates.")
    told = f"the rates leave {own:.1%} of the attitude's turning over 0.25 s"
    if own <= SOUND_ATTITUDE:
        return LogCheck(ATTITUDE, True, f"{told}.")
    best, words = own, ""
    for order in (logged.order,) if logged.angles else ("wxyz", "xyzw"):
        for turns in ("body to world", "world to body"):
            other = logged.read(q, order, turns)
            for factor, unit in ((1.0, ""), (np.pi / 180.0, "deg/s"), (180.0 / np.pi, "rad/s")):
                for sign in (1.0, -1.0):
                    way = AttitudeWay("wxyz", "body to world", "rad/s", (1.0, sign, sign))
                    left = attitude_left(t, other, factor * w, way)
                    if left < best:
                        best, words = left, _attitude_words(logged, order, turns, unit, sign)
    if BETTER * best < own:
        text = f"the rates leave {own:.0%} of the attitude's turning, and {best:.1%} if {words}."
        return LogCheck(ATTITUDE, False, text, f"read or write the attitude and the rates so: {words}")
    text = f"{told}, whatever their order, direction and unit: of another body or time."
    return LogCheck(
        ATTITUDE, None, text, "look at the attitude and the rates: one is of another body or time"
    )


def _attitude_words(logged: _Logged, order: str, turns: str, unit: str, sign: float) -> str:
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


def _velocity(t: Array, q: Array, p: Array, v: Array) -> list[LogCheck]:
    ways = list(velocity_ways())
    left = [velocity_left(t, q, p, v, way) for way in ways]
    sizes = [velocity_left(t, q, p, factor * v, ways[0]) for factor in _SIZES]
    out = []
    if not np.isfinite(left[0]):
        out.append(LogCheck(VELOCITY, None, "too little movement to compare position and velocity."))
    else:
        k, size = int(np.nanargmin(left)), int(np.nanargmin(sizes))
        other = min(left[k], sizes[size])
        if left[0] > SOUND_VELOCITY and BETTER * other < left[0]:
            by = f"{_SIZES[size]:g} times as large: a unit of one of them (`unit`)"
            words = _velocity_words(ways[k]) if left[k] <= sizes[size] else f"they are {by}"
            text = f"velocities leave {percent(left[0])} of the movement, and {other:.1%} if {words}."
            remedy = f"read or write the velocities so: {words}"
            out.append(LogCheck(VELOCITY, False, text, remedy))
        elif left[0] <= NOISY_VELOCITY:
            text = f"velocities leave {left[0]:.1%} of the movement over 0.25 s."
            out.append(LogCheck(VELOCITY, True, text))
        elif _noise_alone(t, p, left[0]):
            text = "too little movement beside the noise to compare position and velocity."
            out.append(LogCheck(VELOCITY, None, text))
        else:
            text = (
                f"velocities leave {percent(left[0])} of the movement over 0.25 s, and no other reading of these "
                "columns does much better: another unit, time or body."
            )
            remedy = "look at the positions and the velocities: one is of another unit, time or body"
            out.append(LogCheck(VELOCITY, None, text, remedy))
    return out


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


def _velocity_words(way: VelocityWay) -> str:
    if way.axes == "body":
        body = "" if way.signs[1] > 0 else " of the other handedness, FRD for FLU"
        return f"they are along the body's axes{body} (`axes: body`)"
    if way.places == (1, 0, 2):
        return "they are NED and the positions ENU, or the other way round (`world` of one of them)"
    return "their third axis has the opposite sign of the position's (one up, one down)"


def _axis(system: SystemInfo, run: RawRun, i: int, j: int, mapping: LogMapping | None) -> LogCheck:
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
    """Whether what rates leave of positions (n, axes) is no more than their noise explains."""
    return left <= NOISY_VELOCITY + 2.0 * noise_share(t, p)


def _exchanged(
    system: SystemInfo, run: RawRun, ways: Sequence[tuple[str, str]], mapping: LogMapping | None
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
    """Words and remedies of readings that do as well."""
    return " or ".join(one.words for one in readings), ", or ".join(one.remedy for one in readings)
