"""MCAP files by the package mcap: messages of ROS 1, ROS 2 and JSON, with the types that the file defines."""

import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.formats import ros
from nsde_torch.data.streams import Stream, StreamLog, optional, ordered, parsing

_CHUNK = 1 << 28  # bytes of a chunk
_DEEPEST, _WIDEST = 8, 64


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
                if len(message.data) > ros.LARGEST or size > ros.MEMORY:
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
        except ros.UnsupportedMessageError as error:
            notes.append(f"{topic} ({kinds[topic] or channel.message_encoding}): left out, {error}")
    return ros.log_of(path.stem, str(path), streams, kinds, notes)


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
        return _json(topic, ros.seconds_since(stamps, since), messages)
    if channel.message_encoding in ("cdr", "ros1") and schema and schema.encoding in ("ros1msg", "ros2msg"):
        types = _types(schema)
        aligned = channel.message_encoding == "cdr"
        return ros.stream_of(topic, _kind(schema), stamps, messages, types, aligned=aligned, since=since)
    encoding = f"{channel.message_encoding} with {schema.encoding}" if schema else channel.message_encoding
    raise ros.UnsupportedMessageError(f"the encoding {encoding!r} is none of ROS 1, ROS 2 and JSON")


def _types(schema: Any) -> ros.Fields:
    """Types of a schema, and those of ROS that every schema may name."""
    try:
        from rosbags.typesys import get_types_from_msg
    except ImportError as error:
        raise ros.UnsupportedMessageError(
            "messages of ROS need the package rosbags, the extra nsde_torch[mcap]"
        ) from error
    try:
        found = get_types_from_msg(schema.data.decode("utf-8"), _kind(schema))
    except Exception as error:  # of a damaged type, nearly anything
        raise ros.UnsupportedMessageError(f"its type cannot be read ({type(error).__name__})") from error
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
        raise ros.UnsupportedMessageError("no numbers in its JSON")
    fields = {name: np.array([row.get(name, np.nan) for row in rows], dtype=np.float64) for name in names}
    return ordered(Stream(topic, stamps, fields))


def _leaves(value: Any, before: str, depth: int) -> Iterator[tuple[str, float]]:
    if isinstance(value, bool | int | float):
        yield before, float(value)
    elif isinstance(value, dict) and depth < _DEEPEST:
        for key, inner in value.items():
            yield from _leaves(inner, f"{before}.{key}" if before else str(key), depth + 1)
    elif isinstance(value, list) and depth < _DEEPEST and len(value) <= _WIDEST:
        for k, inner in enumerate(value):
            yield from _leaves(inner, f"{before}[{k}]", depth + 1)
