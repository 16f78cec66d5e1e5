"""Sticks and setpoints of PX4 logs as further columns: signals that a loop may be moved by from outside.

| columns | topic |
|---|---|
| `stick_roll`, `stick_pitch`, `stick_yaw`, `stick_throttle` | `manual_control_setpoint`, as logged |
| `setpoint_roll`, `setpoint_pitch`, `setpoint_yaw` [rad], `setpoint_thrust` | `vehicle_attitude_setpoint`, FLU in ENU |
| `setpoint_rate_x`, `setpoint_rate_y`, `setpoint_rate_z` [rad/s] | `vehicle_rates_setpoint`, FLU |

Sticks are outside the loop while a pilot flies by them; setpoints are in the modes in which no outer loop makes them
(`nsde train` tests it). Values are held from message to message. Fields: PX4 message definitions, 1.13 to 1.16.
"""

from collections.abc import Callable, Mapping

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.frames import attitude_to_enu

TOPICS = ("manual_control_setpoint", "vehicle_attitude_setpoint", "vehicle_rates_setpoint")
_STICKS = {  # column -> field of PX4 1.14 and later, field before
    "stick_roll": ("roll", "y"),
    "stick_pitch": ("pitch", "x"),
    "stick_yaw": ("yaw", "r"),
    "stick_throttle": ("throttle", "z"),
}
_KNOWN = 0.5  # share of the rows that must have a value


def setpoint_columns(topics: Mapping[str, tuple[Array, Mapping[str, Array]]], t: Array) -> dict[str, Array]:
    """Columns at the times `t` (n,), of the topics that a log has.

    Args:
        topics: Times and fields of each topic.
        t: Times of the rows [s].
    """
    makers: dict[str, Callable[[Mapping[str, Array]], dict[str, Array]]] = {
        "manual_control_setpoint": _sticks,
        "vehicle_attitude_setpoint": _attitude,
        "vehicle_rates_setpoint": _rates,
    }
    out: dict[str, Array] = {}
    for topic, make in makers.items():
        if topic not in topics:
            continue
        times, fields = topics[topic]
        left = np.searchsorted(times, t, side="right") - 1
        for name, values in make(fields).items():
            held = np.where(left >= 0, values[np.clip(left, 0, None)], np.nan)
            if np.isfinite(held).mean() >= _KNOWN:
                out[name] = held
    return out


def _sticks(fields: Mapping[str, Array]) -> dict[str, Array]:
    out = {}
    for name, choices in _STICKS.items():
        there = [field for field in choices if field in fields]
        if there:
            out[name] = fields[there[0]]
    return out


def _attitude(fields: Mapping[str, Array]) -> dict[str, Array]:
    out = {}
    if all(f"q_d[{k}]" in fields for k in range(4)):
        w, x, y, z = attitude_to_enu(np.stack([fields[f"q_d[{k}]"] for k in range(4)], 1)).T
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        out["setpoint_roll"] = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        out["setpoint_pitch"] = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
        good = np.isfinite(yaw)
        yaw[good] = np.unwrap(yaw[good])
        out["setpoint_yaw"] = yaw
    if "thrust_body[2]" in fields:
        out["setpoint_thrust"] = -fields["thrust_body[2]"]
    return out


def _rates(fields: Mapping[str, Array]) -> dict[str, Array]:
    signs = {
        "setpoint_rate_x": ("roll", 1.0),
        "setpoint_rate_y": ("pitch", -1.0),
        "setpoint_rate_z": ("yaw", -1.0),
    }
    return {name: sign * fields[field] for name, (field, sign) in signs.items() if field in fields}
