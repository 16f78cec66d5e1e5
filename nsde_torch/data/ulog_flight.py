"""Which rows of a PX4 log are flight, and which steps of its estimate are no motion.

On the ground: `landed`, `ground_contact` or `maybe_landed` of `vehicle_land_detected`, and the rows next to them that
are less than 10 cm above where it stood then: PX4 says `landed` seconds after it stands, and no longer as soon as it is
told to climb. With such rows in it a log says that thrust lifts nothing.

Resets: where a counter of the estimate grew (`reset_counter` of `vehicle_odometry`, `quat_reset_counter`, ...) heading,
position or velocity made a step. Field meanings: PX4 message definitions, 1.13 to 1.16.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from nsde_torch.arrays import Array
from nsde_torch.data.raw import holes

Mask = NDArray[np.bool_]
Fields = Mapping[str, Array]

FLAGS = ("landed", "maybe_landed", "ground_contact")
CLEAR = 0.1
"""Height above where it stood, up to which a row next to time on the ground is on the ground [m]."""
NEXT_TO = 4.0
"""How long before and after time on the ground such rows are looked for [s]."""
SAME_PLACE = 1.0
"""Difference of height up to which it landed where it took off, so that an estimate that sinks is seen [m]."""
_EDGE = 0.3
"""Time at the edge of time on the ground over which the height is taken [s]."""
CUT = 0.05
"""Time after a reset that is left out, so that the run is cut there [s]."""
COUNTERS = (
    "reset_counter",
    "quat_reset_counter",
    "xy_reset_counter",
    "z_reset_counter",
    "vxy_reset_counter",
    "vz_reset_counter",
    "heading_reset_counter",
)


def on_ground(times: Array, fields: Fields, t: Array, height: Array) -> Mask:
    """Rows in which it stands on the ground.

    Args:
        times: Times of `vehicle_land_detected` [s].
        fields: Its fields.
        t: Times of the rows [s].
        height: Of the rows, upwards [m].
    """
    left = np.clip(np.searchsorted(times, t, side="right") - 1, 0, None)
    flags = np.zeros(len(t), dtype=bool)
    for name in FLAGS:
        if name in fields:
            flags |= fields[name][left] > 0.5
    out = flags.copy()
    first: float | None = None
    for a, b in holes(flags):
        near_a, near_b = t < t[a] + _EDGE, t >= t[b - 1] - _EDGE
        inside = np.zeros(len(t), dtype=bool)
        inside[a:b] = True
        came, went = _level(height[inside & near_a]), _level(height[inside & near_b])
        first = went if first is None else first
        if abs(came - first) < SAME_PLACE:
            came = max(came, first)
        above = np.flatnonzero(~((t >= t[a] - NEXT_TO) & (height < came + CLEAR)))
        out[above[above < a].max(initial=-1) + 1 : a] = True
        above = np.flatnonzero(~((t <= t[b - 1] + NEXT_TO) & (height < went + CLEAR)))
        out[b : above[above >= b].min(initial=len(t))] = True
    return out


def _level(height: Array) -> float:
    known = height[np.isfinite(height)]
    return float(np.median(known)) if len(known) else float("-inf")


def after_resets(sources: Sequence[tuple[Array, Fields]], t: Array) -> tuple[Mask, int]:
    """Rows right after a reset of the estimate, and how many resets there were.

    Args:
        sources: Times and fields of the topics that the state comes from.
        t: Times of the rows [s].
    """
    out, stamps = np.zeros(len(t), dtype=bool), set[float]()
    for times, fields in sources:
        for name in COUNTERS:
            if name in fields:
                stamps |= set(times[1:][np.diff(fields[name]) != 0].tolist())
    for stamp in stamps:
        # a slower topic tells it late: what lies between its two messages is either before or after
        out |= (t > stamp - 1e-9) & (t < stamp + CUT)
    return out, len(stamps)
