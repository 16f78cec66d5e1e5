"""ROS 1 bags (.bag) and ROS 2 bags (.db3, or a folder with one) by rosbags, with the types that the bag defines."""

from __future__ import annotations

from pathlib import Path

from nsde_torch.data.formats.log import StreamLog, lacking, unreadable
from nsde_torch.data.formats.ros import UnsupportedMessageError, log_of, stream_of
from nsde_torch.data.streams import Stream

_LARGEST = 1 << 20  # bytes of a message
_MEMORY = 3 << 28  # bytes of messages that are kept at a time


def open_rosbag(path: Path) -> StreamLog:
    """The topics of one bag.

    Raises:
        DataError: not a bag, a damaged one, or one without topics of numbers.
        ConfigError: the package is not installed.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise lacking("rosbags", "rosbag", path) from error
    streams: dict[str, Stream] = {}
    kinds: dict[str, str] = {}
    notes: list[str] = []
    try:
        # types that a bag of ROS 2 before Iron does not define are those of its distribution
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
            types = {name: fields for name, (_, fields) in bag.typestore.fielddefs.items()}
            for topic in sorted({c.topic for c in bag.connections}):
                connections = [c for c in bag.connections if c.topic == topic]
                stamps: list[int] = []
                messages: list[bytes] = []
                size = 0
                for _, stamp, raw in bag.messages(connections=connections):
                    size += len(raw)
                    if len(raw) > _LARGEST or size > _MEMORY:
                        break
                    stamps.append(stamp)
                    messages.append(bytes(raw))
                if size > _MEMORY or len(messages) < 2:
                    notes.append(
                        f"{topic}: left out ({'too large' if messages or size else 'fewer than two messages'})"
                    )
                    continue
                kind = connections[0].msgtype
                try:
                    streams[topic] = stream_of(
                        topic, kind, stamps, messages, types, aligned=bag.is2, since=bag.start_time // 10**9
                    )
                    kinds[topic] = kind
                except UnsupportedMessageError as error:
                    notes.append(f"{topic} ({kind}): left out, {error}")
    except Exception as error:  # a damaged bag makes the parser raise nearly anything
        raise unreadable(path, "ROS bag", error) from error
    return log_of(path.stem, str(path), streams, kinds, notes)
