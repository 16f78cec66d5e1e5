"""`nsde vehicle` from the command line: what it is, and what it refuses to be."""

import socket
from pathlib import Path

import pytest

from nsde_torch.cli.main import main
from nsde_torch.px4.link.codec import Codec, signing_key
from tests.helpers.commands import Said

pytestmark = pytest.mark.usefixtures("elsewhere")


def test_a_port_in_use_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        url = f"udpin:127.0.0.1:{other.getsockname()[1]}"
        assert main(["vehicle", f"link.url={url}", "duration=5"]) == 2
    assert "another program" in capsys.readouterr().err


def test_it_says_what_it_is_and_its_frames_are_signed_and_of_its_system(
    capsys: pytest.CaptureFixture[str],
) -> None:
    Path("key").write_text("open sesame")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours:
        ours.bind(("127.0.0.1", 0))
        words = [f"link.url=udpout:127.0.0.1:{ours.getsockname()[1]}", "link.system=7", "link.key_file=key"]
        machine = ["plant=quadrotor", "plant.effects=[{linear_drag:{drag:[0.5,0.5,0.1]}}]", "seed=3"]
        assert main(["vehicle", *words, *machine, "duration=1.5", "parameters.COM_OF_LOSS_T=0.5"]) == 0
        ours.settimeout(5.0)
        codec = Codec(1, 1, key=signing_key("open sesame"))
        heard = codec.unpack(ours.recv(4096), 0.0)
    printed = capsys.readouterr().out
    assert "a simulated quadrotor" in printed
    assert "ran " in printed
    assert heard[0].get_type() == "HEARTBEAT"
    assert heard[0].get_srcSystem() == 7
    assert list(Path().iterdir()) == [Path("key")]


@pytest.mark.parametrize(
    "words",
    [
        ["hil=tcpin:127.0.0.1:0"],
        ["--hil", "tcpin:127.0.0.1:0"],
        ["--hil=tcpin:127.0.0.1:0", "sensors=sih", "sensors.accelerometer_bias=[0.1,0,-0.1]"],
    ],
)
def test_as_px4s_simulator_it_waits_and_says_what_px4_must_know(words: list[str], shown: Said) -> None:
    printed = shown("vehicle", *words, "duration=0.1")
    assert "waiting for PX4" in printed
    assert "param set CA_ROTOR_COUNT 6" in printed
    assert "param set CA_ROTOR0_PY 1" in printed
