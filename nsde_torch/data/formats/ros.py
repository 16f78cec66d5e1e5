"""ROS: bags (.bag of ROS 1; .db3 of ROS 2, or a folder with one) by rosbags, and topics of any log as streams.

Times are the stamps of the messages where they have them, else those of the log. ROS counts in ENU and FLU (REP 103)
with quaternions `x y z w`; the twist of an odometry is along the body's axes. Messages of PX4 (`px4_msgs`) are NED and
FRD with quaternions `w x y z`.
"""

import json
import struct
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from nsde_torch.arrays import Array
from nsde_torch.data.streams import Stream, StreamLog, optional, ordered, parsing
from nsde_torch.errors import DataError

# Messages of ROS to columns, many at a time.
#
# A message's layout follows from its type, and from the lengths of its strings and sequences: it is worked
# out once for each combination of lengths, and all messages that share it are read as one array. CDR aligns
# numbers to their size (at most 8 bytes, counted after the four bytes that say the byte order); ROS 1 does
# not align.

Fields = Mapping[str, Sequence[tuple[str, tuple[int, Any]]]]
"""Types by name: names of their fields, and of each the kind and what it is of, as rosbags has them."""

BASE, NAME, SEQUENCE = 1, 2, 4
"""Kinds of a field: a number or string, a message, any number of something; 3 is so many of something."""
_NUMBERS = {
    "bool": "u1", "byte": "u1", "char": "u1", "octet": "u1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
_LONGEST = 64  # elements of an array that become columns
_DEEPEST, _MOST_LAYOUTS = 16, 1000
_TOGETHER = 20_000  # messages that are read at a time
LARGEST = 1 << 20  # bytes of a message at most: images and clouds are no signals
MEMORY = 3 << 28  # bytes of messages that are kept at a time


class UnsupportedMessageError(ValueError):
    """A message whose layout cannot be worked out; the topic is left out."""


class _Layout:
    """Where one message has its numbers (place and type by column) and its lengths (place and value)."""

    def __init__(self, raw: bytes, kind: str, types: Fields, *, aligned: bool) -> None:
        self.raw, self.types, self.aligned = raw, types, aligned
        if aligned and (len(raw) < 4 or raw[0] or raw[1] > 1):
            raise UnsupportedMessageError("an encoding other than plain CDR")
        self.order = ">" if aligned and raw[1] == 0 else "<"
        self.at = self.start = 4 if aligned else 0
        self.columns: dict[str, tuple[int, str]] = {}
        self.lengths: list[tuple[int, int]] = []
        self.message(kind, "", 0)

    def message(self, kind: str, before: str, depth: int) -> None:
        if depth > _DEEPEST or kind not in self.types:
            raise UnsupportedMessageError(f"the type {kind} is not defined in the log")
        for name, what in self.types[kind]:
            self.one(what, before + name, depth)

    def one(self, what: tuple[int, Any], name: str, depth: int) -> None:
        kind, of = int(what[0]), what[1]
        if kind == BASE:
            self.base(of[0], [name])
        elif kind == NAME:
            self.message(of, f"{name}.", depth + 1)
        else:
            (inner, base), count = of
            count = self.length() if kind == SEQUENCE else int(count)
            if int(inner) == BASE and base[0] in _NUMBERS:
                self.base(base[0], [f"{name}[{k}]" for k in range(count)] if count <= _LONGEST else [], count)
                return
            if count > LARGEST:
                raise UnsupportedMessageError("a sequence that is longer than the message")
            for k in range(count):
                self.one((inner, base), f"{name}[{k}]", depth + 1)

    def base(self, kind: str, names: Sequence[str], count: int = 1) -> None:
        """A string, or so many numbers in a row; those with a name become columns."""
        if kind == "string":
            self.move(self.length())
        elif kind not in _NUMBERS:
            raise UnsupportedMessageError(f"numbers of the type {kind}")
        elif count:
            size = np.dtype(_NUMBERS[kind]).itemsize
            self.align(size)
            for k, name in enumerate(names):
                self.columns[name] = (self.at + k * size, self.order + _NUMBERS[kind])
            self.move(size * count)

    def length(self) -> int:
        self.align(4)
        place = self.at
        self.move(4)
        value = int(struct.unpack_from(f"{self.order}I", self.raw, place)[0])
        self.lengths.append((place, value))
        return value

    def align(self, size: int) -> None:
        if self.aligned:
            self.at += -(self.at - self.start) % size

    def move(self, size: int) -> None:
        self.at += size
        if self.at > len(self.raw):
            raise UnsupportedMessageError("a message that is cut short")


def columns_of(messages: Sequence[bytes], kind: str, types: Fields, *, aligned: bool) -> dict[str, Array]:
    """Numbers of messages of one type, a column (n,) for each; what a message lacks is nan there.

    The types are those that the log defines; messages are `aligned` in CDR (ROS 2), and not in ROS 1.
    """
    left, sizes = np.arange(len(messages)), np.array([len(m) for m in messages])
    out: dict[str, Array] = {}
    why = "messages of many layouts"
    for _ in range(_MOST_LAYOUTS):
        if not len(left):
            break
        first = messages[left[0]]
        same = left[sizes[left] == len(first)]
        try:
            layout = _Layout(first, kind, types, aligned=aligned)
        except UnsupportedMessageError as error:
            why, left = str(error), left[1:]
            continue
        read = [same[:0]]
        for start in range(0, len(same), _TOGETHER):
            rows = same[start : start + _TOGETHER]
            table = np.frombuffer(b"".join(messages[k] for k in rows), dtype=np.uint8)
            table = table.reshape(len(rows), len(first))
            fits = (table[:, :2] == np.frombuffer(first[:2], dtype=np.uint8)).all(axis=1) | (not aligned)
            for at, value in layout.lengths:
                fits &= _at(table, at, f"{layout.order}u4") == value
            rows, table = rows[fits], table[fits]
            read.append(rows)
            for name, (at, number) in layout.columns.items():
                if name in _TIMES or not any(part in name for part in _NOT_SIGNALS):
                    if name not in out:
                        out[name] = np.full(len(messages), np.nan)
                    out[name][rows] = _at(table, at, number)
        left = np.setdiff1d(left, np.concatenate(read), assume_unique=True)
    if len(left) or not out:
        raise UnsupportedMessageError(why)
    return out


def _at(table: NDArray[np.uint8], at: int, number: str) -> NDArray[Any]:
    kind = np.dtype(number)
    return np.ascontiguousarray(table[:, at : at + kind.itemsize]).view(kind)[:, 0]


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
    """The messages of one topic (see `columns_of`), with the times [ns] at which they were logged.

    Times are counted from a second `since` 1970 [s]: whole ones have no digits left for microseconds.
    """
    columns = columns_of(messages, kind, types, aligned=aligned)
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
    kept = {k: v[good] for k, v in columns.items() if not k.startswith(("header.", "stamp."))}
    if not kept:
        raise UnsupportedMessageError("no numbers beside its header")
    return ordered(Stream(topic, t[good], kept))


def seconds_since(stamps: Sequence[int], since: int) -> NDArray[np.float64]:
    """Times [s] of stamps [ns], counted from a second since 1970."""
    return np.asarray(np.array(stamps, dtype=np.int64) - since * 10**9, dtype=np.float64) * 1e-9


def log_of(
    name: str, source: str, streams: Mapping[str, Stream], kinds: Mapping[str, str], notes: Sequence[str]
) -> StreamLog:
    """A log of topics, with what their types (`kinds`) say of them; `notes` are of what was left out."""
    if not streams:
        told = "; ".join(notes[:3])
        raise DataError(f"{source} holds no topic of numbers{f' ({told})' if told else ''}.")
    px4 = any(kind.startswith(_PX4) for kind in kinds.values())
    frames = {"world": "NED", "body": "FRD"} if px4 else {"world": "ENU", "body": "FLU"}
    said: dict[bool, dict[str, list[dict[str, Any]]]] = {True: {}, False: {}}  # by odometries, and by others
    for topic, stream in streams.items():
        for meant, entry in _meaning(topic, kinds[topic], stream).items():
            said["Odometry" in kinds[topic]].setdefault(meant, []).append(entry)
    # of several, none is said to be the one
    columns = {meant: found[0] for meant, found in (said[False] | said[True]).items() if len(found) == 1}
    return StreamLog(name, source, list(streams.values()), columns, frames, list(notes))


def _meaning(topic: str, kind: str, stream: Stream) -> dict[str, dict[str, Any]]:
    """Entries of a mapping that follow from the type of a topic."""

    def of(group: str, axes: str = "xyz") -> list[str]:
        return [f"{topic}/{group}.{axis}" for axis in axes]

    def numbered(group: str, numbers: Iterable[int]) -> list[str]:
        return [f"{topic}/{group}[{k}]" for k in numbers]

    out: dict[str, dict[str, Any]] = {}
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
        out["p"] = {"from": numbered("position", range(3)), "unit": "m"}
        out["v"] = {"from": numbered("velocity", range(3)), "unit": "m/s", "axes": "world"}
        out["q"] = {"from": numbered("q", range(4)), "order": "wxyz"}
        out["w"] = {"from": numbered("angular_velocity", range(3)), "unit": "rad/s"}
    if kind == f"{_PX4}ActuatorMotors":
        used = [k for k in range(12) if np.isfinite(stream.fields.get(f"control[{k}]", np.nan)).any()]
        out["u"] = {"from": numbered("control", used), "unit": "1", "numbering": "px4"}
    if kind == f"{_PX4}BatteryStatus":
        out["battery_voltage"] = {"from": [f"{topic}/voltage_v"], "unit": "V"}
    if kind == "sensor_msgs/msg/BatteryState":
        out["battery_voltage"] = {"from": [f"{topic}/voltage"], "unit": "V"}
    there = {f"{topic}/{name}" for name in stream.fields}
    return {name: entry for name, entry in out.items() if entry["from"] and set(entry["from"]) <= there}


def open_rosbag(path: Path) -> StreamLog:
    """The topics of one bag, with the types that it defines."""
    reader, typesys = (optional(f"rosbags.{name}", "rosbag", path) for name in ("highlevel", "typesys"))
    streams: dict[str, Stream] = {}
    kinds: dict[str, str] = {}
    notes: list[str] = []
    # types that a bag of ROS 2 before Iron does not define are those of its distribution
    usual = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    with parsing(path, "ROS bag"), reader.AnyReader([path], default_typestore=usual) as bag:
        types = {name: fields for name, (_, fields) in bag.typestore.fielddefs.items()}
        for topic in sorted({c.topic for c in bag.connections}):
            connections = [c for c in bag.connections if c.topic == topic]
            stamps: list[int] = []
            messages: list[bytes] = []
            size, large = 0, False
            for _, stamp, raw in bag.messages(connections=connections):
                size += len(raw)
                large = len(raw) > LARGEST or size > MEMORY
                if large:
                    break
                stamps.append(stamp)
                messages.append(bytes(raw))
            if large or len(messages) < 2:
                notes.append(f"{topic}: left out ({'too large' if large else 'fewer than two messages'})")
                continue
            kind, since = connections[0].msgtype, bag.start_time // 10**9
            try:
                streams[topic] = stream_of(topic, kind, stamps, messages, types, aligned=bag.is2, since=since)
                kinds[topic] = kind
            except UnsupportedMessageError as error:
                notes.append(f"{topic} ({kind}): left out, {error}")
    return log_of(path.stem, str(path), streams, kinds, notes)


# MCAP files by the package mcap: messages of ROS 1, ROS 2 and JSON, with the types that the file defines.

_CHUNK = 1 << 28  # bytes of a chunk
_NESTED, _WIDEST_LIST = 8, 64


def open_mcap(path: Path) -> StreamLog:
    """The channels of one file; one that ends in the middle is read up to there."""
    damage = optional("mcap.exceptions", "mcap", path).McapError
    messages: dict[str, list[bytes]] = defaultdict(list)
    stamps: dict[str, list[int]] = defaultdict(list)
    about: dict[str, tuple[Any, Any]] = {}
    notes: list[str] = []
    large: set[str] = set()
    size = 0
    with parsing(path, "MCAP file"), path.open("rb") as file:
        try:
            for schema, channel, message in _messages(file):
                topic = channel.topic
                if len(message.data) > LARGEST or size > MEMORY:
                    large.add(topic)
                    continue
                size += len(message.data)
                about[topic] = (schema, channel)
                messages[topic].append(message.data)
                stamps[topic].append(message.log_time)
        except (damage, EOFError) as error:
            if not messages:
                raise
            notes.append(f"the file ends in the middle ({type(error).__name__}): read up to there")
    notes += [f"{topic}: left out, large messages" for topic in sorted(large)]
    since = min((times[0] for times in stamps.values()), default=0) // 10**9
    streams: dict[str, Stream] = {}
    kinds: dict[str, str] = {}
    for topic, (schema, channel) in sorted(about.items()):
        if topic in large or len(messages[topic]) < 2:
            continue
        try:
            kinds[topic] = _kind(schema)
            streams[topic] = _stream(topic, schema, channel, stamps[topic], messages[topic], since)
        except UnsupportedMessageError as error:
            notes.append(f"{topic} ({kinds[topic] or channel.message_encoding}): left out, {error}")
    return log_of(path.stem, str(path), streams, kinds, notes)


def _messages(file: IO[bytes]) -> Iterator[tuple[Any, Any, Any]]:
    """Schema, channel and message of each message in the order of the file; huge chunks are refused unpacked."""
    from mcap.exceptions import McapError
    from mcap.records import Channel, Chunk, Message, Schema
    from mcap.stream_reader import StreamReader, breakup_chunk

    schemas, channels = dict[int, Any](), dict[int, Any]()
    for record in StreamReader(file, emit_chunks=True, record_size_limit=_CHUNK).records:
        if isinstance(record, Chunk) and _unpacked(record) > _CHUNK:
            raise McapError(f"a chunk of {_unpacked(record)} bytes; at most {_CHUNK} are unpacked")
        for one in breakup_chunk(record) if isinstance(record, Chunk) else (record,):
            if isinstance(one, Schema):
                schemas[one.id] = one
            elif isinstance(one, Channel):
                channels[one.id] = one
            elif isinstance(one, Message) and one.channel_id in channels:
                channel = channels[one.channel_id]
                yield schemas.get(channel.schema_id), channel, one


def _unpacked(chunk: Any) -> int:
    """Size of a chunk once unpacked, as it says and as its compressed data say."""
    size = int(chunk.uncompressed_size)
    if chunk.compression == "zstd":
        import zstandard

        told = int(zstandard.get_frame_parameters(chunk.data).content_size)
        if told != zstandard.CONTENTSIZE_UNKNOWN:  # else no more is unpacked than the chunk says
            size = max(size, told)
    elif chunk.compression == "lz4":
        import lz4.frame

        size = max(size, int(lz4.frame.get_frame_info(chunk.data)["content_size"]))
    return size


def _kind(schema: Any) -> str:
    name = schema.name if schema else ""
    return name if name.count("/") != 1 else name.replace("/", "/msg/")


def _stream(
    topic: str, schema: Any, channel: Any, stamps: Sequence[int], messages: Sequence[bytes], since: int
) -> Stream:
    if channel.message_encoding == "json":
        return _json(topic, seconds_since(stamps, since), messages)
    if channel.message_encoding in ("cdr", "ros1") and schema and schema.encoding in ("ros1msg", "ros2msg"):
        types = _types(schema)
        aligned = channel.message_encoding == "cdr"
        return stream_of(topic, _kind(schema), stamps, messages, types, aligned=aligned, since=since)
    encoding = f"{channel.message_encoding} with {schema.encoding}" if schema else channel.message_encoding
    raise UnsupportedMessageError(f"the encoding {encoding!r} is none of ROS 1, ROS 2 and JSON")


def _types(schema: Any) -> Fields:
    """Types of a schema, and those of ROS that every schema may name."""
    try:
        from rosbags.typesys import get_types_from_msg
    except ImportError as error:
        raise UnsupportedMessageError(
            "messages of ROS need the package rosbags, the extra nsde_torch[mcap]"
        ) from error
    try:
        found = get_types_from_msg(schema.data.decode("utf-8"), _kind(schema))
    except Exception as error:  # of a damaged type, nearly anything
        raise UnsupportedMessageError(f"its type cannot be read ({type(error).__name__})") from error
    times: dict[str, Any] = {
        f"builtin_interfaces/msg/{name}": [("sec", (1, ("int32", 0))), ("nanosec", (1, ("uint32", 0)))]
        for name in ("Time", "Duration")
    }
    return {**times, **{name: fields for name, (_, fields) in found.items()}}


def _json(topic: str, stamps: Array, messages: Sequence[bytes]) -> Stream:
    rows = []
    for message in messages:
        try:
            rows.append(dict(_leaves(json.loads(message), "", 0)))
        except (ValueError, RecursionError):
            rows.append({})
    names = list(dict.fromkeys(name for row in rows for name in row))
    if not names:
        raise UnsupportedMessageError("no numbers in its JSON")
    fields = {name: np.array([row.get(name, np.nan) for row in rows], dtype=np.float64) for name in names}
    return ordered(Stream(topic, stamps, fields))


def _leaves(value: Any, before: str, depth: int) -> Iterator[tuple[str, float]]:
    if isinstance(value, bool | int | float):
        yield before, float(value)
    elif isinstance(value, dict) and depth < _NESTED:
        for key, inner in value.items():
            yield from _leaves(inner, f"{before}.{key}" if before else str(key), depth + 1)
    elif isinstance(value, list) and depth < _NESTED and len(value) <= _WIDEST_LIST:
        for k, inner in enumerate(value):
            yield from _leaves(inner, f"{before}[{k}]", depth + 1)
