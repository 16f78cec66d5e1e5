"""Frames: what is right comes through, what is wrong is counted and costs little."""

import random

import pytest
from pymavlink.generator.mavcrc import x25crc

from nsde_torch.errors import ConfigError
from nsde_torch.px4.link.codec import BUDGET, Codec, crc16, signing_key
from nsde_torch.px4.link.dialect import INT32, REAL32, mavlink, parameter_number, parameter_value
from nsde_torch.px4.link.endpoint import WANTED

KEY = bytes(range(32))


HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 12, 1, 0, 4, 3)


def test_the_checksum_is_mavlinks() -> None:
    data = random.Random(0).randbytes(200)
    reference = x25crc(data)
    reference.accumulate(bytes((77,)))
    assert crc16(data, 77) == reference.crc


def test_frames_come_through_whole_in_pieces_and_in_one_go() -> None:
    sender = Codec(1, 1)
    frames = [sender.pack(HEARTBEAT) for _ in range(5)]
    assert len(Codec(2, 1).unpack(b"".join(frames), 0.0)) == 5
    stream = Codec(2, 1, stream=True)
    data = b"noise" + b"".join(frames)
    assert sum(len(stream.unpack(data[k : k + 3], 0.0)) for k in range(0, len(data), 3)) == 5


def test_every_single_flipped_bit_is_found() -> None:
    frame = Codec(1, 1).pack(HEARTBEAT)
    for at in range(len(frame)):
        for bit in range(8):
            bad = frame[:at] + bytes((frame[at] ^ 1 << bit,)) + frame[at + 1 :]
            assert Codec(2, 1).unpack(bad, 0.0) == []


def test_signed_frames_are_taken_once_and_only_with_the_right_key() -> None:
    wall = iter(range(10**9, 10**9 + 100))
    sender = Codec(1, 1, key=KEY, wall=lambda: float(next(wall)))
    receiver = Codec(2, 1, key=KEY, wall=lambda: 1e9)
    frame = sender.pack(HEARTBEAT)
    assert len(receiver.unpack(frame, 0.0)) == 1
    assert receiver.unpack(frame, 0.0) == []
    assert receiver.counts["replay"] == 1
    assert receiver.unpack(Codec(1, 1).pack(HEARTBEAT), 0.0) == []
    assert receiver.counts["unsigned"] == 1
    assert receiver.unpack(Codec(1, 1, key=bytes(32)).pack(HEARTBEAT), 0.0) == []
    assert receiver.counts["signature"] == 1


def test_a_stranger_cannot_move_the_time_of_signatures() -> None:
    sender = Codec(1, 1, key=KEY, wall=lambda: 1.5e9)
    forger = Codec(1, 1, key=bytes(32), wall=lambda: 1.9e9)
    receiver = Codec(2, 1, key=KEY, wall=lambda: 1.5e9)
    assert len(receiver.unpack(sender.pack(HEARTBEAT), 0.0)) == 1
    receiver.unpack(forger.pack(HEARTBEAT), 0.0)
    assert len(receiver.unpack(sender.pack(HEARTBEAT), 0.0)) == 1


def test_a_recording_of_last_week_is_not_played_to_us() -> None:
    old = Codec(1, 1, key=KEY, wall=lambda: 1.5e9 - 7 * 86400)
    receiver = Codec(2, 1, key=KEY, wall=lambda: 1.5e9)
    assert receiver.unpack(old.pack(HEARTBEAT), 0.0) == []


def test_only_one_system_and_only_wanted_messages_are_decoded() -> None:
    receiver = Codec(2, 1, wanted=WANTED)
    receiver.only = 1
    assert receiver.unpack(Codec(9, 1).pack(HEARTBEAT), 0.0) == []
    unwanted = mavlink.MAVLink_vfr_hud_message(0.0, 0.0, 0, 0, 0.0, 0.0)
    assert receiver.unpack(Codec(1, 1).pack(unwanted), 0.0) == []
    assert receiver.counts == {"foreign": 1, "unwanted": 1}


def test_a_flood_is_decoded_up_to_a_budget_a_second() -> None:
    frame = Codec(1, 1).pack(HEARTBEAT)
    receiver = Codec(2, 1)
    got = sum(len(receiver.unpack(frame, 5.0)) for _ in range(2 * BUDGET))
    assert got == BUDGET
    assert len(receiver.unpack(frame, 6.0)) == 1


def test_whole_numbers_travel_as_the_bytes_of_a_float() -> None:
    for value in (0, 1, -7, 6001, 2**31 - 1):
        assert parameter_value(parameter_number(value, INT32), INT32) == value
    assert parameter_value(parameter_number(0.5, REAL32), REAL32) == 0.5


def test_keys_are_hexadecimal_or_a_passphrase() -> None:
    assert signing_key(KEY.hex()) == KEY
    assert len(signing_key("open sesame")) == 32
    with pytest.raises(ConfigError, match="empty"):
        signing_key("")
