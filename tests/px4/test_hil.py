"""A machine as PX4's simulator, against values worked by hand and against a stand-in for PX4 in lockstep."""

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from itertools import pairwise
from math import atan2, degrees, radians, sqrt
from typing import Any

import pytest

from nsde_torch.px4.link.codec import Codec
from nsde_torch.px4.link.connection import TcpIn
from nsde_torch.px4.link.dialect import mavlink
from nsde_torch.px4.link.vectors import Quat, Vec, from_rotation_vector, rotate, turned_by_rates
from nsde_torch.px4.options import SensorErrors
from nsde_torch.px4.simulator.body import Body
from nsde_torch.px4.simulator.hil import (
    BAROMETER,
    FIELD_NED,
    MAGNETOMETER,
    HilPlant,
    HilSensors,
    HilServer,
    airframe,
    place,
    pressure,
)

S = sqrt(0.5)
REST: Vec = (0.0, 0.0, 0.0)
EAST: Quat = (1.0, 0.0, 0.0, 0.0)
"""Level, nose east: no turn in ENU."""
NORTH: Quat = (S, 0.0, 0.0, S)


def _plant(system: str = "quadrotor", **more: Any) -> HilPlant:
    return HilPlant(Body(system, seed=0, process_noise=0.0, **more), seed=0, noise=0.0)


def _of(messages: list[Any], name: str = "HIL_SENSOR") -> Any:
    return next(m for m in messages if m.get_type() == name)


def _shown(*, v: Vec = REST, q: Quat = NORTH, w: Vec = REST, p: Vec = REST, samples: int = 1) -> list[Any]:
    """Messages of some samples of one state."""
    sensors = HilSensors(seed=0, noise=0.0)
    sensors.messages(1.0, p, v, q, w)
    return [m for k in range(samples) for m in sensors.messages(1.0 + 0.004 * (k + 1), p, v, q, w)]


@pytest.mark.parametrize(
    ("what", "before", "after", "q", "shown"),
    [
        ("at rest minus g along FRD z", REST, REST, NORTH, (0.0, 0.0, -9.81)),
        # FLU y points left, so a nose that rises turns about minus y; specific force is up, along x
        ("nose straight up", REST, REST, (S, 0.0, -S, 0.0), (9.81, 0.0, 0.0)),
        ("speeding up northwards, nose north", REST, (0.0, 0.008, 0.0), NORTH, (2.0, 0.0, -9.81)),
        ("a touch-down, as hard as sensors show", (0.0, 0.0, -3.0), REST, NORTH, (0.0, 0.0, -4 * 9.81)),
    ],
)
def test_the_accelerometer_shows_the_specific_force(
    what: str, before: Vec, after: Vec, q: Quat, shown: Vec
) -> None:
    sensors = HilSensors(seed=0, noise=0.0)
    sensors.messages(1.0, REST, before, q, REST)
    imu = _of(sensors.messages(1.004, REST, after, q, REST))
    assert (imu.xacc, imu.yacc, imu.zacc) == pytest.approx(shown, rel=1e-5, abs=1e-5), what


@pytest.mark.parametrize(
    ("tilt", "v"),
    [
        *((0.0, (0.3, 0.0, -speed)) for speed in (0.2, 0.68, 1.28, 3.0)),
        # a real PX4 came down like this after its stream had been cut, and believed in 9 m/s where it stood still
        *((tilt, (2.3, 1.0, -1.8)) for tilt in (10.0, 25.0, 60.0)),
    ],
)
def test_a_machine_that_has_come_down_is_level_and_at_rest_for_who_integrates_what_sensors_show(
    tilt: float, v: Vec
) -> None:
    sensors = HilSensors(seed=0, noise=0.0)
    q = from_rotation_vector((radians(tilt), 0.0, 0.0))
    for _ in range(60):
        sensors.messages(1.0, REST, v, q, REST)
    for k in range(100):
        imu = _of(sensors.messages(1.004 + 0.004 * k, REST, REST, EAST, REST))
        q = turned_by_rates(q, (imu.xgyro, -imu.ygyro, -imu.zgyro), 0.004)
        a = rotate(q, (imu.xacc, -imu.yacc, -imu.zacc))
        v = (v[0] + 0.004 * a[0], v[1] + 0.004 * a[1], v[2] + 0.004 * (a[2] - 9.81))
        assert max(abs(imu.xgyro), abs(imu.ygyro), abs(imu.zgyro)) < 10.001
        assert tilt or sqrt(imu.xacc**2 + imu.yacc**2 + imu.zacc**2) < 4.001 * 9.81
    assert q == pytest.approx(EAST, abs=1e-6)
    assert v == pytest.approx(REST, abs=1e-3)


def test_the_field_points_north_and_down_and_turns_with_the_nose() -> None:
    north, east = _of(_shown()), _of(_shown(q=EAST))
    assert (north.xmag, north.ymag, north.zmag) == pytest.approx(FIELD_NED)
    assert degrees(atan2(FIELD_NED[1], FIELD_NED[0])) == pytest.approx(3.0)
    # nose east: what lay ahead lies to the left, which is minus y
    assert (east.xmag, east.ymag, east.zmag) == pytest.approx((FIELD_NED[1], -FIELD_NED[0], FIELD_NED[2]))


def test_pressure_is_that_of_the_standard_atmosphere_and_altitude_comes_back_from_it() -> None:
    assert pressure(0.0) == pytest.approx(1013.25)
    assert pressure(1000.0) == pytest.approx(898.75, abs=0.05)  # ISO 2533, table
    imu = _of(_shown(p=(0.0, 0.0, 12.0)))
    assert imu.abs_pressure == pytest.approx(pressure(500.0), abs=1e-3)
    assert imu.pressure_alt == pytest.approx(500.0, abs=0.1)


def test_slower_sensors_say_by_their_bits_when_they_are_new() -> None:
    sent = _shown(samples=100)
    imu = [m for m in sent if m.get_type() == "HIL_SENSOR"]
    assert len(imu) == 100
    assert all(m.fields_updated & 0b111_111 == 0b111_111 for m in imu)
    assert sum(m.fields_updated & MAGNETOMETER == MAGNETOMETER for m in imu) == 25
    assert sum(m.fields_updated & BAROMETER == BAROMETER for m in imu) == 20
    assert all(m.fields_updated & BAROMETER in (0, BAROMETER) for m in imu)
    assert sum(m.get_type() == "HIL_GPS" for m in sent) == 4
    assert [m.time_usec for m in imu[:2]] == [1_004_000, 1_008_000]


def test_position_and_velocity_go_north_and_east() -> None:
    gps = _of(_shown(p=(30.0, 40.0, 5.0), v=(0.0, 2.0, 1.0), samples=25), "HIL_GPS")
    assert (gps.vn, gps.ve, gps.vd) == (200, 0, -100)
    assert gps.cog == 0
    assert gps.fix_type == 3
    assert gps.alt == 493_000
    lat, lon, _ = place(REST)
    metre = 1e7 / 111_194.9  # of latitude
    assert gps.lat - lat == pytest.approx(40.0 * metre, abs=2)
    assert gps.lon - lon == pytest.approx(30.0 * metre / 0.67688, abs=3)


@pytest.mark.parametrize("delay", [0.0, 0.01, 0.11])
def test_a_gps_says_where_the_machine_was_a_delay_ago(delay: float) -> None:
    sensors = HilSensors(seed=0, noise=0.0, errors=SensorErrors(gps_delay=delay))
    flown = [
        (0.004 * k, m)
        for k in range(200)
        for m in sensors.messages(0.004 * k, (0.0, 4.0 * 0.004 * k, 0.0), (0.0, 4.0, 0.0), NORTH, REST)
        if m.get_type() == "HIL_GPS"
    ]
    north = place((0.0, 1.0, 0.0))[0] - place(REST)[0]
    late = [t - (m.lat - place(REST)[0]) / north / 4.0 for t, m in flown[2:]]
    assert late == pytest.approx([delay] * len(late), abs=0.001)
    assert len(late) > 4


@pytest.mark.parametrize(
    ("system", "places", "turns"),
    [
        # front right, rear left, front left, rear right; the first two turn counter-clockwise
        ("quadrotor", [(1, 1), (-1, -1), (1, -1), (-1, 1)], "++--"),
        (
            "hexacopter",
            [(0, 1), (0, -1), (0.866, -0.5), (-0.866, 0.5), (0.866, 0.5), (-0.866, -0.5)],
            "-+-++-",
        ),
    ],
)
def test_rotors_are_where_px4_has_them(system: str, places: list[tuple[float, float]], turns: str) -> None:
    found, n = airframe(Body(system, seed=0).system, 0.5), len(places)
    assert found["CA_ROTOR_COUNT"] == n
    assert [(found[f"CA_ROTOR{k}_PX"], found[f"CA_ROTOR{k}_PY"]) for k in range(n)] == places
    assert [found[f"CA_ROTOR{k}_KM"] for k in range(n)] == [0.05 if turn == "+" else -0.05 for turn in turns]
    assert [found[f"PWM_MAIN_FUNC{k + 1}"] for k in range(n)] == [101 + k for k in range(n)]


class Px4:
    """Stands for PX4: answers each sample of the IMU with motor commands, one message each, as lockstep has it."""

    def __init__(self, *, lockstep: bool = True, armed: bool = True) -> None:
        self.codec = Codec(1, 1, stream=True)
        self.lockstep, self.armed, self.heard = lockstep, armed, 0
        self.messages: list[Any] = []

    def answer(self, data: bytes, controls: tuple[float, ...]) -> bytes:
        """What it says to what it hears."""
        out = b""
        for message in self.codec.unpack(data, float(self.heard // 1000)):
            self.messages.append(message)
            if message.get_type() == "HIL_SENSOR":
                self.heard += 1
                row, mode = [*controls, *[0.0] * (16 - len(controls))], 129 if self.armed else 1
                said = (message.time_usec, row, mode, int(self.lockstep))
                out += self.codec.pack(mavlink.MAVLink_hil_actuator_controls_message(*said))
        return out


def _run(plant: HilPlant, px4: Px4, motors: tuple[float, ...], samples: int) -> None:
    for _ in range(samples):
        plant.receive(px4.answer(plant.sample(), motors))
        plant.body.step(plant.controls)


@pytest.mark.parametrize("system", ["quadrotor", "hexacopter"])
def test_more_than_hovering_throttle_lifts_it_and_no_throttle_lets_it_fall_freely(system: str) -> None:
    plant, px4 = _plant(system, declared_only=True), Px4()
    _run(plant, px4, (1.2 * plant.body.hover_throttle(),) * plant.body.nu, 250)
    assert plant.body.p[2] > 0.3
    assert px4.heard == plant.answers == 250
    assert px4.messages[-1].time_usec / 1e6 == pytest.approx(1.0 + 249 * 0.004)
    _run(plant, px4, (0.0,) * plant.body.nu, 20)
    assert _of(px4.messages[::-1]).zacc == pytest.approx(0.0, abs=0.05)


def test_more_on_the_left_rolls_right_and_turns_by_the_reaction() -> None:
    plant, px4 = _plant("quadrotor", declared_only=True), Px4()
    hover = plant.body.hover_throttle()
    _run(plant, px4, (1.3 * hover,) * 4, 100)
    _run(plant, px4, (1.3 * hover, 1.35 * hover, 1.35 * hover, 1.3 * hover), 20)  # 2 and 3 are on the left
    imu = _of(px4.messages[::-1])
    assert imu.xgyro > 0.05
    assert abs(imu.ygyro) < 1e-6


def test_controls_of_a_disarmed_px4_and_those_that_are_no_number_turn_nothing() -> None:
    plant = _plant()
    plant.receive(Px4(armed=False).answer(plant.sample(), (0.5,) * 4))
    assert plant.controls == (0.0,) * 4
    plant.receive(Px4().answer(plant.sample(), (float("nan"), 2.0, -1.0, 0.5)))
    assert plant.controls == (0.0, 1.0, 0.0, 0.5)


@contextlib.contextmanager
def _served(says: list[str]) -> Iterator[tuple[HilServer, tuple[str, int]]]:
    transport = TcpIn("127.0.0.1", 0)
    server = HilServer(_plant, transport, say=says.append, speed=100.0)
    stop = threading.Event()
    thread = threading.Thread(target=server.run, args=(stop.is_set,), daemon=True)
    thread.start()
    try:
        yield server, transport.address
    finally:
        stop.set()
        thread.join(10.0)
        transport.close()
        assert not thread.is_alive()


def _fly(address: tuple[str, int], samples: int, px4: Px4) -> None:
    """Connect, answer some samples, and go."""
    with socket.create_connection(address, timeout=10.0) as connection:
        connection.sendall(px4.codec.pack(mavlink.MAVLink_heartbeat_message(2, 12, 1, 0, 3, 3)))
        while px4.heard < samples:
            connection.sendall(px4.answer(connection.recv(4096), (0.55,) * 4))


def test_px4_is_waited_for_served_in_lockstep_and_served_again_from_the_ground() -> None:
    says: list[str] = []
    with _served(says) as (server, address):
        for _ in range(2):
            px4 = Px4()
            _fly(address, 200, px4)
            imu = [m.time_usec for m in px4.messages if m.get_type() == "HIL_SENSOR"]
            # in lockstep no sample is left out, and the second one finds a new machine
            assert imu[:3] == [1_000_000, 1_004_000, 1_008_000]
            assert [b - a for a, b in pairwise(imu)] == [4000] * (len(imu) - 1)
            end = time.monotonic() + 10.0
            while server.plant.body.time > 0.0 and time.monotonic() < end:
                time.sleep(0.01)
        assert server.plant.body.on_ground
    assert says.count("PX4 is here") == 2
    assert "put back on the ground" in says[2]


def test_a_px4_that_answers_nothing_gets_sensors_all_the_same() -> None:
    says: list[str] = []
    with _served(says) as (_, address), socket.create_connection(address, timeout=10.0) as connection:
        codec, count = Codec(1, 1, stream=True), 0
        while count < 50:
            count += len(codec.unpack(connection.recv(4096), 0.0))
