"""What columns hold that are not what they are read as: times in another unit, columns exchanged, a unit or a sign.

    p(t + T) - p(t) = int v dt         (T = 0.25 s)

holds for a position and its rate. Where it fails as the columns are read and holds in another reading, that one is
named. In a sound log it holds as it is, and nothing else is looked at.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from math import pi

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.formats.clock import SECONDS
from nsde_torch.data.mapping.kinematic import (
    NOISY_VELOCITY,
    SOUND_ATTITUDE,
    SOUND_VELOCITY,
    AttitudeWay,
    VelocityWay,
    attitude_left,
    velocity_left,
)
from nsde_torch.data.mapping.mapping import LogMapping
from nsde_torch.data.raw import RawRun
from nsde_torch.data.system_info import SystemInfo, rate_columns, rate_pairs

BETTER = 10.0
"""Times less that another reading of the columns must leave."""
_SLOW_S, _FAST_S, _FASTEST_S = 0.5, 2e-5, 1e-5
"""Steps beyond which times are taken for another unit, and the shortest that they then may have [s]."""
_ALIKE = 2.0  # times the least that is left, up to which two readings do as well
_LENGTHS = (("mm", 1e-3), ("cm", 1e-2), ("ft", 0.3048))


@dataclass(frozen=True)
class Misread:
    """Another reading of columns, in which they agree.

    Args:
        words: What would be so.
        remedy: What to do.
        left: Share of the motion that is left then.
    """

    words: str
    remedy: str
    left: float


def percent(share: float) -> str:
    """A share of a motion; a large one as a multiple."""
    return f"{share:.1%}" if share < 10.0 else f"{share:.2g} times all"


def pair_left(t: Array, p: Array, v: Array) -> float:
    """Share of the movement of one position over 0.25 s that its rate leaves; nan of too little motion.

    Args:
        t: Times [s], (n,).
        p: Position, (n,).
        v: Its rate, (n,).
    """
    return velocity_left(t, None, p[:, None], v[:, None], VelocityWay("world", (0,), (1.0,)))  # type: ignore[arg-type]


def times_misread(system: SystemInfo, run: RawRun, mapping: LogMapping | None) -> Misread | None:
    """Another unit of the times, in which all positions follow their rates; None where there is none.

    Only steps that no log of a moving machine has are looked at: a rate in mm/s does the same to one pair of columns.

    Args:
        system: The machine.
        run: In the order of time.
        mapping: What made it; None: columns of the package's own.
    """
    step = float(np.median(np.diff(run.t))) if len(run.t) > 1 else 0.0
    if not (step >= _SLOW_S or 0 < step < _FAST_S) or _all_sound(system, run, 1.0):
        return None
    clock = None if mapping is None else mapping.time
    now = (clock.unit if clock else None) or "s"
    row_s = _row_s(system, run) if step == SECONDS[now] else None
    if row_s is not None and _all_sound(system, run, row_s / step):
        words = f"the times count rows; with rows {row_s:.3g} s apart they agree with all rates"
        entry = f"`time: {{rate: {1.0 / row_s:.4g}}}`"
        remedy = f"write times in seconds, or read the files as tables, with {entry} in a mapping"
        return Misread(words, remedy, 0.0)
    for unit, seconds in SECONDS.items():
        size = seconds / SECONDS[now]
        if unit != now and _FASTEST_S <= size * step < _SLOW_S and _all_sound(system, run, size):
            name = clock.source if clock and clock.source else "t"
            entry = f"`time: {{from: {name}, unit: {unit}}}`"
            remedy = (
                f"write {entry} in the mapping"
                if clock and clock.source
                else f"write `t` in seconds, or read the files as tables, with {entry} in a mapping "
                "(`nsde inspect LOG kind=table` writes one)"
            )
            words = f"rows are {step:.4g} s apart as the times are read; in {unit} they agree with all rates"
            return Misread(words, remedy, 0.0)
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
        way = AttitudeWay("wxyz", "body to world", "rad/s", (1.0, 1.0, 1.0))
        left.append((attitude_left(t, run.x[:, system.quaternion], run.x[:, rates], way), SOUND_ATTITUDE))
    known = [(share, most) for share, most in left if np.isfinite(share)]
    return bool(known) and all(share <= most for share, most in known)


def exchanged(system: SystemInfo, run: RawRun) -> list[list[tuple[str, str]]]:
    """Columns that agree with all others once two are exchanged, and do not as they are; each with what does the same.

    Args:
        system: The machine.
        run: In its units, axes and order.
    """
    names = system.state_names
    pairs = [(names[i], names[j]) for i, j in rate_pairs(system)]
    columns = {name: run.x[:, names.index(name)] for pair in pairs for name in pair}
    free = system.quaternion is None  # axes of one vector are exchanged by a frame, of which others speak
    if free:
        columns |= {
            name: run.u[:, k] for k, name in enumerate(system.input_names) if len(run.u) == len(run.t)
        }

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


def rate_misread(
    system: SystemInfo, run: RawRun, i: int, j: int, mapping: LogMapping | None
) -> list[Misread]:
    """Units and signs of a position or its rate in which the two agree, the best first; none in a sound log.

    Args:
        system: The machine.
        run: In its units, axes and order.
        i: Column of the position.
        j: Column of its rate.
        mapping: What made it; a unit that it reads wrongly does what another unit of the other column does.
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
            entry = None if mapping is None else mapping.columns.get(other)
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
