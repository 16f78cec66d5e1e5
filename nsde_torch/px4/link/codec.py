"""MAVLink 2 frames: bytes in, messages out, and the other way round, whatever the bytes are.

A frame is `FD len incompat compat seq sys comp id(3) payload crc(2) [link time(6) signature(6)]` (MAVLink developer
guide, "Serialization" and "Message signing"). Cheap tests come first, so that a flood of rubbish costs microseconds a
frame: header, sender, message, budget, then the checksum in C, then the signature, and only then decoding.

    crc = CRC-16/MCRF4XX = bits reversed of (polynomial 0x1021 over bytes reversed),    start 0xFFFF
    signature = first 6 bytes of SHA-256(key, frame without signature)

A signature's time must grow; it is compared only after the signature itself was found right, so that a stranger
cannot move it.
"""

import binascii
import hashlib
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import KW_ONLY, dataclass
from typing import Any, final

from nsde_torch.errors import ConfigError
from nsde_torch.px4.link.dialect import mavlink

Message = Any  # a message of pymavlink; which fields it has depends on its type

V1, V2 = 0xFE, 0xFD
_HEADER = {V1: 6, V2: 10}
_SIGNED, _SIGNATURE = 0x01, 13
_REVERSED = bytes(int(f"{k:08b}"[::-1], 2) for k in range(256))
_EPOCH = 1420070400.0  # start of the clock of signatures, 1 January 2015 [s]
_MINUTE = 6_000_000
BUDGET = 1500  # frames of one message that are decoded in a second; PX4 sends a tenth of it


def crc16(data: bytes, extra: int) -> int:
    """Checksum of a frame without its first byte, with the extra byte of its message."""
    reflected = binascii.crc_hqx((data + bytes((extra,))).translate(_REVERSED), 0xFFFF)
    return int.from_bytes(reflected.to_bytes(2, "big").translate(_REVERSED), "little")


def signing_key(text: str) -> bytes:
    """Key of 32 bytes from 64 hexadecimal digits, or a passphrase (SHA-256 of it); ConfigError where there is none."""
    if not text:
        raise ConfigError("the signing key is empty; give 64 hexadecimal digits or a passphrase.")
    try:
        key = bytes.fromhex(text)
    except ValueError:
        key = b""
    return key if len(key) == 32 else hashlib.sha256(text.encode()).digest()


@final
@dataclass(eq=False)
class Codec:
    """Frames of one connection."""

    system: int  # own system id, 1 to 255
    component: int  # own component id
    _: KW_ONLY
    key: bytes | None = None  # for signing, of 32 bytes; None: messages are neither signed nor need to be
    wanted: frozenset[int] | None = None  # ids of the messages to decode; None: all
    stream: bool = False  # whether bytes come as a stream, where a frame may be cut into pieces
    wall: Callable[[], float] = time.time  # wall clock [s], for the time of signatures

    def __post_init__(self) -> None:
        ids = self.system, self.component
        if not all(1 <= one <= 255 for one in ids):
            raise ConfigError(f"system and component ids must be 1 to 255; got {ids[0]} and {ids[1]}.")
        if self.key is not None and len(self.key) != 32:
            raise ConfigError(f"a signing key has 32 bytes; got {len(self.key)}.")
        self.only: int | None = None  # the system that is listened to; None: any
        self.counts: Counter[str] = Counter()  # of frames: `good`, `crc`, `unsigned`, `foreign`, `flood`, ...
        self._out = mavlink.MAVLink(None, srcSystem=self.system, srcComponent=self.component)
        self._in = mavlink.MAVLink(None)
        if self.key is not None:
            self._out.signing.secret_key, self._out.signing.sign_outgoing = self.key, True
        self._times: dict[tuple[int, int, int], int] = {}
        self._rest = b""
        self._second, self._spent = -1, Counter[int]()

    def pack(self, message: Message) -> bytes:
        if self.key is not None:
            self._out.signing.timestamp = max(self._out.signing.timestamp, self._now())
        packed: bytes = message.pack(self._out)
        self._out.seq = (self._out.seq + 1) % 256
        return packed

    def unpack(self, data: bytes, now: float) -> list[Message]:
        """Messages in bytes, a datagram or a piece of a stream; what is no message is counted and skipped.

        The budget is for each second of `now`, a time of any clock that runs [s].
        """
        if int(now) != self._second:
            self._second = int(now)
            self._spent.clear()
        decoded = map(self._decoded, self._frames(data))
        return [message for message in decoded if message is not None]

    def _now(self) -> int:
        return int((self.wall() - _EPOCH) * 1e5)

    def _frames(self, data: bytes) -> Iterator[bytes]:
        """Frames whose marks, lengths and checksums are right."""
        if self.stream:
            data, self._rest = self._rest + data, b""
        at, end = 0, len(data)
        while at < end:
            mark = data[at]
            if mark not in _HEADER:
                at = _next_mark(data, at + 1)
                self.counts["rubbish"] += 1
                continue
            head = _HEADER[mark]
            if end - at < head:
                self._keep(data[at:])
                return
            signed = mark == V2 and data[at + 2] & _SIGNED
            size = head + data[at + 1] + 2 + (_SIGNATURE if signed else 0)
            if end - at < size:
                if self.stream and end - at < 280:
                    self._keep(data[at:])
                    return
                self.counts["cut"] += 1
                at = _next_mark(data, at + 1)
                continue
            verdict = self._verdict(data[at : at + size], mark, head)
            if verdict == "good":
                yield data[at : at + size]
                at += size
            else:
                self.counts[verdict] += 1
                # a wrong length or checksum may hide the start of a true frame
                at = _next_mark(data, at + 1) if verdict in ("crc", "flags") else at + size

    def _keep(self, rest: bytes) -> None:
        if self.stream:
            self._rest = rest
        else:
            self.counts["cut"] += 1

    def _verdict(self, frame: bytes, mark: int, head: int) -> str:
        system = frame[5] if mark == V2 else frame[3]
        number = int.from_bytes(frame[7:10], "little") if mark == V2 else frame[5]
        if mark == V2 and frame[2] & ~_SIGNED:
            return "flags"
        if self.wanted is not None and number not in self.wanted:
            return "unwanted"
        kind = mavlink.mavlink_map.get(number)
        if kind is None:
            return "unknown"
        if self.only is not None and system != self.only:
            return "foreign"
        end = head + frame[1]
        if crc16(frame[1:end], kind.crc_extra) != frame[end] | frame[end + 1] << 8:
            return "crc"
        if self.key is not None and (trouble := self._signature(frame, mark)) is not None:
            return trouble
        self._spent[number] += 1
        return "good" if self._spent[number] <= BUDGET else "flood"

    def _signature(self, frame: bytes, mark: int) -> str | None:
        """What is wrong with the signature, if anything."""
        if mark != V2 or not frame[2] & _SIGNED:
            return "unsigned"
        assert self.key is not None
        if hashlib.sha256(self.key + frame[:-6]).digest()[:6] != frame[-6:]:
            return "signature"
        source = (frame[-13], frame[5], frame[6])
        stamp = int.from_bytes(frame[-12:-6], "little")
        last = self._times.get(source)
        if (last is not None and stamp <= last) or (last is None and stamp + _MINUTE < self._now()):
            return "replay"
        self._times[source] = stamp
        return None

    def _decoded(self, frame: bytes) -> Message | None:
        try:
            message = self._in.decode(bytearray(frame))
        except (mavlink.MAVError, struct.error, ValueError, UnicodeDecodeError, IndexError):
            self.counts["undecodable"] += 1
            return None
        self.counts["good"] += 1
        return message


def _next_mark(data: bytes, start: int) -> int:
    """Where the next frame may begin."""
    found = [k for k in (data.find(V2, start), data.find(V1, start)) if k >= 0]
    return min(found) if found else len(data)
