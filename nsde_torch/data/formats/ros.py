"""Topics of ROS as streams: what a stamp, an odometry and a pose mean.

Times are the stamps of the messages where they have them, else those of the log. ROS counts in ENU and FLU (REP 103)
with quaternions `x y z w`; the twist of an odometry is along the body's axes. Messages of PX4 (`px4_msgs`) are NED and
FRD with quaternions `w x y z`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data.formats.log import StreamLog
from nsde_torch.data.formats.ros_layout import Fields, UnsupportedMessageError, columns_of
from nsde_torch.data.streams import Stream, ordered
from nsde_torch.errors import DataError

_PX4 = "px4_msgs/msg/"
_STAMPS = (("header.stamp.sec", "header.stamp.nanosec"), ("stamp.sec", "stamp.nanosec"))
_TIMES = {name for pair in _STAMPS for name in pair}
_NOT_SIGNALS = ("covariance", "header.", "stamp.", "layout.")
_POSES = {
    "nav_msgs/msg/Odometry": ("pose.pose.position", "pose.pose.orientation"),
    "geometry_msgs/msg/PoseStamped": ("pose.position", "pose.orientation"),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("pose.pose.position", "pose.pose.orientation"),
    "geometry_msgs/msg/TransformStamped": ("transform.translation", "transform.rotation"),
}


def stream_of(
    topic: str,
    kind: str,
    stamps: Sequence[int],
    messages: Sequence[bytes],
    types: Fields,
    *,
    aligned: bool,
    since: int,
) -> Stream:
    """The messages of one topic.

    Args:
        topic: Its name.
        kind: Type of its messages.
        stamps: Times at which they were logged [ns].
        messages: As they are in the log.
        types: The types that the log defines.
        aligned: Whether they are CDR (ROS 2), else ROS 1.
        since: Second from which times are counted [s]: those since 1970 have no digits left for microseconds.

    Raises:
        UnsupportedMessageError: the messages cannot be read as numbers.
    """
    columns, _ = columns_of(messages, kind, types, aligned=aligned, wanted=_wanted)
    t = seconds_since(stamps, since)
    for seconds, rest in _STAMPS:
        if seconds in columns and rest in columns:
            told = columns[seconds] - since + 1e-9 * columns[rest]
            if np.isfinite(told).all() and (columns[seconds] > 0).all():
                t = told
            break
    if kind.startswith(_PX4) and (columns.get("timestamp", np.zeros(1)) > 0).all():
        sample = columns.get("timestamp_sample")
        t = (columns["timestamp"] if sample is None or not (sample > 0).all() else sample) * 1e-6
    good = np.isfinite(t)
    kept = {k: v for k, v in columns.items() if not k.startswith(("header.", "stamp."))}
    if not kept:
        raise UnsupportedMessageError("no numbers beside its header")
    if not good.all():
        t, kept = t[good], {k: v[good] for k, v in kept.items()}
    return ordered(Stream(topic, t, kept))


def seconds_since(stamps: Sequence[int], since: int) -> NDArray[np.float64]:
    """Times [s] of stamps [ns], counted from a second since 1970."""
    return np.asarray(np.array(stamps, dtype=np.int64) - since * 10**9, dtype=np.float64) * 1e-9


def _wanted(name: str) -> bool:
    return name in _TIMES or not any(part in name for part in _NOT_SIGNALS)


def log_of(
    name: str, source: str, streams: Mapping[str, Stream], kinds: Mapping[str, str], notes: Sequence[str]
) -> StreamLog:
    """A log of topics, with what their types say of them.

    Args:
        name: Of the run.
        source: File.
        streams: By topic.
        kinds: Type of each topic.
        notes: What was left out.

    Raises:
        DataError: no topic holds numbers.
    """
    if not streams:
        told = "; ".join(notes[:3])
        raise DataError(f"{source} holds no topic of numbers{f' ({told})' if told else ''}.")
    px4 = any(kind.startswith(_PX4) for kind in kinds.values())
    frames = {"world": "NED", "body": "FRD"} if px4 else {"world": "ENU", "body": "FLU"}
    columns: dict[str, dict[str, object]] = {}
    offers: dict[str, list[tuple[int, dict[str, object]]]] = {}
    for topic, stream in streams.items():
        for meant, entry in _meaning(topic, kinds[topic], stream).items():
            offers.setdefault(meant, []).append((0 if "Odometry" in kinds[topic] else 1, entry))
    for meant, found in offers.items():
        first = [entry for rank, entry in found if rank == min(rank for rank, _ in found)]
        if len(first) == 1:  # of several, none is said to be the one
            columns[meant] = first[0]
    return StreamLog(name, source, list(streams.values()), columns, frames, list(notes))


def _meaning(topic: str, kind: str, stream: Stream) -> dict[str, dict[str, object]]:
    """Entries of a mapping that follow from the type of a topic."""

    def of(group: str, axes: str = "xyz") -> list[str]:
        return [f"{topic}/{group}.{axis}" for axis in axes]

    out: dict[str, dict[str, object]] = {}
    if kind in _POSES:
        position, orientation = _POSES[kind]
        out["p"] = {"from": of(position), "unit": "m"}
        out["q"] = {"from": of(orientation, "wxyz"), "order": "wxyz"}
    if kind == "nav_msgs/msg/Odometry":
        out["v"] = {"from": of("twist.twist.linear"), "unit": "m/s", "axes": "body"}
        out["w"] = {"from": of("twist.twist.angular"), "unit": "rad/s"}
    if kind == "sensor_msgs/msg/Imu":
        out["w"] = {"from": of("angular_velocity"), "unit": "rad/s"}
    if kind == f"{_PX4}VehicleOdometry":
        out["p"] = {"from": [f"{topic}/position[{k}]" for k in range(3)], "unit": "m"}
        out["v"] = {"from": [f"{topic}/velocity[{k}]" for k in range(3)], "unit": "m/s", "axes": "world"}
        out["q"] = {"from": [f"{topic}/q[{k}]" for k in range(4)], "order": "wxyz"}
        out["w"] = {"from": [f"{topic}/angular_velocity[{k}]" for k in range(3)], "unit": "rad/s"}
    if kind == f"{_PX4}ActuatorMotors":
        used = [
            k for k in range(12) if np.isfinite(stream.fields.get(f"control[{k}]", np.array([np.nan]))).any()
        ]
        out["u"] = {"from": [f"{topic}/control[{k}]" for k in used], "unit": "1", "numbering": "px4"}
    if kind == f"{_PX4}BatteryStatus":
        out["battery_voltage"] = {"from": f"{topic}/voltage_v", "unit": "V"}
    if kind == "sensor_msgs/msg/BatteryState":
        out["battery_voltage"] = {"from": f"{topic}/voltage", "unit": "V"}
    return {name: entry for name, entry in out.items() if _there(entry["from"], topic, stream)}


def _there(sources: object, topic: str, stream: Stream) -> bool:
    names = [sources] if isinstance(sources, str) else list(sources) if isinstance(sources, list) else []
    return bool(names) and all(name.removeprefix(f"{topic}/") in stream.fields for name in names)
