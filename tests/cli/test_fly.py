"""`nsde fly` and `nsde vehicle`, to files: what is wrong is said before anything is connected to."""

import csv
import json
import socket
from pathlib import Path
from typing import Any

import pytest

from nsde_torch.cli import fly_build, track_build
from nsde_torch.cli.main import main
from nsde_torch.effects import files
from nsde_torch.errors import ConfigError
from nsde_torch.px4.flight import flying
from nsde_torch.px4.flight.safety import Phase
from nsde_torch.px4.link import connection as links
from nsde_torch.px4.link import dialect as d
from nsde_torch.px4.link.codec import Codec, signing_key
from nsde_torch.px4.simulator.autopilot import SimulatedAutopilot
from nsde_torch.px4.simulator.body import Body
from nsde_torch.px4.simulator.simulated import VirtualLink
from tests.helpers.commands import Said

pytestmark = pytest.mark.usefixtures("elsewhere")


SHORT = ("reference=hover", "reference.duration=1", "height=1", "reference.height=1", "hold=0.3")


@pytest.fixture
def vehicles(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Every link that is opened leads to a vehicle in virtual time; what was asked for is listed."""
    asked: list[dict[str, Any]] = []

    def opened(url: str, **more: Any) -> VirtualLink:
        asked.append({"url": url, **more})
        body = Body("quadrotor", seed=len(asked), latency=0.02)
        return VirtualLink(SimulatedAutopilot(body, seed=len(asked), key=more["key"]), key=more["key"])

    monkeypatch.setattr(links, "open_link", opened)
    return asked


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run=pid", "system=cartpole"], "multirotors"),
        (["run=nothere"], "no run directory nothere"),
        (["run=pid", "reference=csv", "reference.path=nope.csv"], "nope.csv"),
        (["run=pid", "reference.speed=20"], "reference.check=false"),
        (["run=pid", "reference.height=-3"], "below the ground"),
        (["run=pid", "link.key_file=nope"], "`link.key_file`: nope does not exist"),
        (["run=pid", "limits.fence=[[1,2]]"], "`limits.fence` takes"),
        (["run=declared", "mpc.moment_time=0.5"], "`mpc.moment_time` is of `nsde track`"),
        (["run=declared", "system.effects=nope.yaml"], "no file 'nope.yaml'"),
    ],
)
def test_faults_of_the_user_end_in_a_sentence_before_anything_is_connected(
    words: list[str], said: str, vehicles: list[dict[str, Any]], refused: Said
) -> None:
    assert said in refused("fly", *words)
    assert not vehicles
    assert not list(Path().rglob("flight.json"))


def test_flights_leave_numbers_and_a_log_each_and_are_not_written_over(
    vehicles: list[dict[str, Any]], refused: Said, shown: Said
) -> None:
    Path("key").write_text("open sesame\n")
    words = ["run=pid", "system=quadrotor", "repeats=2", "link.system=1", "link.key_file=key", "out_dir=out"]
    printed = shown("fly", *words, *SHORT)
    assert "the reference was flown; landed and disarmed; RMSE" in printed
    assert [v["url"] for v in vehicles] == ["udpin:127.0.0.1:14540"] * 2
    assert vehicles[0]["target"] == 1
    assert len(vehicles[0]["key"]) == 32
    content = json.loads(Path("out/flight.json").read_text())
    assert content["system"] == "quadrotor"
    assert "key_file" not in content["link"]
    assert [f["tracked"] for f in content["flights"]] == [True, True]
    assert all(0.0 < f["rmse_m"] < 0.2 for f in content["flights"])
    with Path("out/log/flight_1.csv").open() as file:
        header = next(csv.reader(file))
    assert header[:4] == ["t", "p_x", "p_y", "p_z"]
    assert "u_4" in header
    assert "u_5" not in header
    assert "holds a flight already" in refused("fly", *words, *SHORT)


def test_the_declared_physics_is_told_of_what_a_diagnosis_found(
    monkeypatch: pytest.MonkeyPatch, refused: Said
) -> None:
    def stop(config: Any, reference: Any, machine: Any) -> None:
        raise ConfigError(f"told of {machine.effect_names[-1]}, {machine.effects[-1].value('drag').tolist()}")

    monkeypatch.setattr(track_build, "envelope", stop)
    files.write(Path("effects.yaml"), "quadrotor", {"linear_drag": {"drag": [0.5, 0.25, 0.125]}}, "found")
    words = ["fly", "run=declared", "system.effects=effects.yaml"]
    assert "was found on system 'quadrotor'" in refused(*words, "system=hexacopter")
    assert "told of linear_drag, [0.5, 0.25, 0.125]" in refused(*words, "system=quadrotor")


@pytest.mark.parametrize(
    ("fault", "status", "said"),
    [
        ("battery", 3, "went wrong, and landed: battery at"),
        ("push", 3, "went wrong, and landed: more than 0.6 m from the reference for 0.5 s"),
        ("mode", 3, "went wrong, and landed: the mode is HOLD"),
        ("link", 4, "NOT seen to land"),
        ("stop", 130, "was stopped, and landed"),
    ],
)
def test_the_exit_status_says_how_a_flight_that_began_went_wrong(
    fault: str, status: int, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    body = Body("quadrotor", seed=1, latency=0.02)
    vehicle = SimulatedAutopilot(body, seed=1)
    link = VirtualLink(vehicle)
    monkeypatch.setattr(links, "open_link", lambda url, **more: link)
    flown = flying.fly

    def fly(*args: Any, **more: Any) -> Any:
        def harm(flight: Any, now: float) -> None:
            if flight.phase is not Phase.TRACK:
                if fault == "mode" and flight.done is False and vehicle.mode == d.HOLD and vehicle.flown:
                    vehicle.set_mode(d.LAND)  # the operator has had enough
                return
            if fault == "battery":
                body.used = 0.95
            elif fault == "push":  # a wind that it cannot hold its place in
                body.v = (body.v[0] + 0.06, *body.v[1:])
            elif fault == "mode":
                vehicle.set_mode(d.HOLD)
            elif fault == "link":
                vehicle.mute = True
            else:
                flight.stop()

        return flown(*args, **more, watch=harm)

    monkeypatch.setattr(flying, "fly", fly)
    assert main(["fly", "run=pid", "system=quadrotor", "out_dir=out", *SHORT]) == status
    assert said in capsys.readouterr().err
    assert json.loads(Path("out/flight.json").read_text())["flights"][0]["trouble"] is not None


@pytest.mark.parametrize(("asked", "status"), [([], 0), (["limits.battery=0.95"], 2)])
def test_a_check_flies_nothing_writes_nothing_and_its_status_says_whether_it_is_fit(
    asked: list[str],
    status: int,
    vehicles: list[dict[str, Any]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def compile(*args: Any) -> None:
        raise AssertionError("a check needs no solver")

    monkeypatch.setattr(fly_build, "Process", compile)
    words = ["run=declared", "system=quadrotor", "check=true", "repeats=3", "out_dir=out"]
    assert main(["fly", *words, *SHORT, *asked]) == status
    said = capsys.readouterr()
    assert ("checked: fit to fly" in said.out) == (status == 0)
    assert ("refused: battery at 100 %: charge it" in said.out) == (status == 2)
    assert len(vehicles) == 1
    assert not list(Path().rglob("flight.json"))
    assert not list(Path().rglob("*.csv"))


def test_a_vehicle_in_the_air_is_landed_and_one_on_the_ground_is_refused(
    vehicles: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, refused: Said, shown: Said
) -> None:
    assert "the vehicle is disarmed: nothing is in the air" in refused("land")
    assert "takeover=true is for a vehicle in the air" in refused(
        "fly", "run=pid", "system=quadrotor", "takeover=true", "out_dir=out", *SHORT
    )
    body = Body("quadrotor", seed=1)
    vehicle = SimulatedAutopilot(body, seed=1)
    link = VirtualLink(vehicle)
    body.p, body.on_ground, vehicle.armed = (0.0, 0.0, 2.0), False, True
    link.pause(0.01)
    vehicle.set_mode(d.LAND)
    vehicle.set_mode(d.HOLD)
    monkeypatch.setattr(links, "open_link", lambda url, **more: link)
    assert "landed and disarmed" in shown("land")
    assert body.on_ground


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
