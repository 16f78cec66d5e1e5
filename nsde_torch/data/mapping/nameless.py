"""What the columns of a table without names are: by what must hold between them, else by their order.

Four neighbours of unit length are a quaternion, the three that turn it its rates, and of positions and velocities the
pair whose movement agrees; as many neighbours as there are motors, never negative and of one size, are the motors.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from nsde_torch.data.formats.clock import UNNAMED
from nsde_torch.data.formats.log import StreamLog
from nsde_torch.data.mapping.kinematic import (
    INTERVAL_S,
    SOUND_ATTITUDE,
    SOUND_VELOCITY,
    attitude_left,
    attitude_ways,
    best,
    read_attitude,
)
from nsde_torch.data.quaternion import rotate
from nsde_torch.data.streams import Stream, moving
from nsde_torch.data.system_info import SystemInfo

_ROWS = 6000  # that are looked at
_UNIT = 0.01  # by which a quaternion's length is off
_ALIKE = 1.5  # times that the usual commands of motors differ


def called(log: StreamLog, system: SystemInfo) -> dict[str, str] | None:
    """Names of the system for the columns of a table without names; None of any other log.

    Args:
        log: The streams.
        system: The machine.
    """
    columns = [column for stream in log.streams for column in stream.fields]
    names = (*system.state_names, *system.input_names)
    if len(log.streams) != 1 or len(columns) < len(names) or not columns[0].startswith(UNNAMED):
        return None
    if system.quaternion is None:
        return dict(zip(columns, names, strict=False))
    found = _by_what_holds(log.streams[0], len(system.input_names))
    return found or dict(zip(columns, names, strict=False))


def _by_what_holds(stream: Stream, motors: int) -> dict[str, str]:
    names = list(stream.fields)
    table = stream.columns(*names)[:_ROWS]
    t, moves = stream.t[:_ROWS], moving(table)
    out: dict[str, str] = {}

    def free(size: int) -> Iterator[list[int]]:
        for k in range(len(names) - size + 1):
            places = list(range(k, k + size))
            if moves[places].all() and not out.keys() & {names[p] for p in places}:
                yield places

    def take(places: Iterable[int], *of: str) -> None:
        out.update(zip([names[p] for p in places], of, strict=True))

    length = [(float(np.abs(np.linalg.norm(table[:, p], axis=1) - 1.0).max()), p) for p in free(4)]
    unit, places = min(length, default=(1.0, []))
    if unit > _UNIT or not stream.timed:
        return {}
    q = table[:, places]
    take(places, "q_0", "q_1", "q_2", "q_3")
    ways = list(attitude_ways(None, None))
    turning = [
        (left[k], p, ways[k])
        for p in free(3)
        for left in [[attitude_left(t, q, table[:, p], way) for way in ways]]
        for k in [best(left)]
        if k is not None
    ]
    left, places, way = min(turning, default=(1.0, [], ways[0]), key=lambda row: row[0])
    if left > SOUND_ATTITUDE:
        return {}
    take(places, "w_x", "w_y", "w_z")
    q = read_attitude(q, way)
    every = max(1, round(INTERVAL_S * stream.rate))
    step = np.diff(t, append=t[-1])[:, None]
    moved = {tuple(p): np.diff(table[::every, p], axis=0) for p in free(3)}
    told = [(p, axes) for p in moved for axes in (table[:, p], rotate(q, table[:, p]))]
    rate = [(v, np.diff(np.cumsum(axes * step, axis=0)[::every], axis=0)) for v, axes in told]
    pairs = [
        (left, p, v)
        for p, change in moved.items()
        for v, movement in rate
        if not set(p) & set(v)
        for left in [np.square(change - movement).sum() / np.square(change - change.mean(axis=0)).sum()]
        if left < SOUND_VELOCITY
    ]
    rates = [v for _, _, v in pairs]
    pairs = [row for row in pairs if row[1] not in rates] or pairs  # what has a rate and is none itself
    if not pairs:
        return {}
    _, position, speeds = min(pairs)
    take(position, "p_x", "p_y", "p_z")
    take(speeds, "v_x", "v_y", "v_z")
    usual = np.median(table, axis=0)
    sizes = [(float(usual[p].max() / usual[p].min()), p) for p in free(motors) if (table[:, p] >= 0.0).all()]
    alike, places = min(sizes, default=(np.inf, []))
    if alike < _ALIKE:
        take(places, *(f"u_{k + 1}" for k in range(motors)))
    return out
