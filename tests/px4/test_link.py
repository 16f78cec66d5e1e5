"""Over real sockets and a serial line, and the frames on them."""

import os
import random
import socket
import time
import tty

import pytest

from nsde_torch.errors import ConfigError
from nsde_torch.px4.link.codec import BUDGET, Codec, signing_key
from nsde_torch.px4.link.connection import Link, LinkError, Serial, UdpIn, UdpOut, open_transport
from nsde_torch.px4.link.dialect import mavlink
from nsde_torch.px4.link.endpoint import WANTED
from nsde_torch.px4.simulator.autopilot import SimulatedAutopilot
from nsde_torch.px4.simulator.body import Body
from nsde_torch.px4.simulator.simulated import Vehicle


def test_the_newest_state_comes_and_a_flood_of_rubbish_changes_nothing() -> None:
    ours = UdpIn("127.0.0.1", 0)
    autopilot = SimulatedAutopilot(Body("quadrotor", seed=0))
    rng = random.Random(0)
    rubbish = [rng.randbytes(200) for _ in range(50)]
    with Vehicle(autopilot, UdpOut(*ours.address)), Link(ours) as link:
        link.wait_for_vehicle(20.0)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as hostile:
            end = time.monotonic() + 1.5
            while time.monotonic() < end:
                for data in rubbish:
                    hostile.sendto(data, ours.address)
                time.sleep(0.005)
        state = link.endpoint.state
        assert link.now() - state.time < 1.0
        assert link.endpoint.telemetry.sync.round_trip is not None
        assert ours.foreign > 100
        assert link.fault is None


def test_no_vehicle_is_an_error_with_a_reason() -> None:
    with Link(UdpIn("127.0.0.1", 0)) as link, pytest.raises(LinkError, match="nothing was heard"):
        link.wait_for_vehicle(0.2)


@pytest.mark.parametrize("url", ["udpin:0.0.0.0:14540", "tcpin:192.168.1.2:4560", "udpin:[::]:14540"])
def test_listening_beyond_loopback_needs_a_word(url: str) -> None:
    with pytest.raises(LinkError, match=r"link.expose=true"):
        open_transport(url)


@pytest.mark.parametrize("url", ["", "udp", "udpin:127.0.0.1", "udpin:127.0.0.1:port", "foo:1.2.3.4:5"])
def test_a_url_that_is_not_understood_lists_what_is(url: str) -> None:
    with pytest.raises(LinkError, match="expected udpin"):
        open_transport(url)


def test_a_device_that_is_not_there_is_named() -> None:
    with pytest.raises(LinkError, match=r"serial:/dev/nothing:57600.* cannot be opened"):
        open_transport("serial:/dev/nothing:57600")


def test_a_plug_that_is_pulled_is_silence_and_no_crash() -> None:
    far, near = os.openpty()
    tty.setraw(far)
    ours = Serial(os.ttyname(near), 921_600)
    os.write(far, b"abc")
    assert ours.receive(1.0) == b"abc"
    ours.send(b"def")
    assert os.read(far, 3) == b"def"
    os.close(far)
    assert ours.receive(0.01) == b""
    ours.send(b"abc")
    ours.close()
    assert ours.receive(0.01) == b""
    os.close(near)


KEY = bytes(range(32))


HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 12, 1, 0, 4, 3)


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


def test_keys_are_hexadecimal_or_a_passphrase() -> None:
    assert signing_key(KEY.hex()) == KEY
    assert len(signing_key("open sesame")) == 32
    with pytest.raises(ConfigError, match="empty"):
        signing_key("")
