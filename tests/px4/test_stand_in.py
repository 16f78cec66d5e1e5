"""The simulated autopilot is as unkind as a real PX4: each behaviour that was seen on one.

docs/content/results/px4.md lists them with these tests.
"""

from collections import Counter
from itertools import pairwise
from math import nan
from typing import Any

import pytest

from nsde_torch.control import shapes
from nsde_torch.px4.flight.cascade import PathPoints
from nsde_torch.px4.flight.safety import Phase
from nsde_torch.px4.link import dialect as d
from nsde_torch.px4.link import frames
from nsde_torch.px4.link.codec import Codec
from nsde_torch.px4.link.dialect import mavlink
from nsde_torch.px4.link.endpoint import NUMBERS
from nsde_torch.px4.link.telemetry import Telemetry
from nsde_torch.px4.simulator.autopilot import SimulatedAutopilot
from nsde_torch.px4.simulator.body import Body
from tests.helpers.px4_world import World, under_way

HOVER = PathPoints(shapes.hover(duration=6.0, height=1.5))


class Client:
    """Says things to a vehicle, and hears what it says."""

    def __init__(self, *, boot: float = 1.5) -> None:
        self.vehicle = SimulatedAutopilot(Body("quadrotor", seed=0))
        self.codec = Codec(245, 190)
        self.heard: list[Any] = []
        self.run(boot)

    def run(self, seconds: float) -> None:
        for frame in self.vehicle.advance(self.vehicle.time + seconds):
            self.heard += self.codec.unpack(frame, self.vehicle.time)

    def say(self, message: Any) -> None:
        self.vehicle.receive(self.codec.pack(message))

    def command(self, number: int, *values: float) -> None:
        row = [*values, *[0.0] * (7 - len(values))]
        self.say(mavlink.MAVLink_command_long_message(1, 1, number, 0, *row))
        self.run(0.02)

    def rates(self, thrust: float, w: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        self.say(mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 128, (1.0, 0.0, 0.0, 0.0), *w, thrust))

    def all(self, name: str) -> list[Any]:
        return [m for m in self.heard if m.get_type() == name]

    def results(self, command: int) -> list[int]:
        return [m.result for m in self.all("COMMAND_ACK") if m.command == command]


def _flying(after: float = 1.0) -> World:
    return under_way(Phase.TRACK, after, path=HOVER)


def _sent(world: World, w: tuple[float, float, float], thrust: float) -> None:
    world.endpoint.send_rates(w, thrust, world.now)
    for data in world._due(world._to_vehicle):
        world.vehicle.receive(data)


def test_offboard_is_accepted_disarmed_without_a_stream_and_refused_at_arming() -> None:
    client = Client()
    client.command(d.SET_MODE, 1, 6)
    assert client.vehicle.mode == d.OFFBOARD
    client.command(d.ARM, 1)
    assert client.results(d.ARM) == [d.TEMPORARILY_REJECTED]
    assert not client.vehicle.armed


def test_a_mode_is_answered_twice_and_the_first_answer_says_nothing() -> None:
    client = Client()
    client.command(d.SET_MODE, 1, 77)
    assert client.results(d.SET_MODE) == [d.ACCEPTED, d.DENIED]
    assert client.vehicle.mode == d.HOLD


def test_texts_come_to_a_link_on_which_a_ground_station_is_heard_and_to_no_other() -> None:
    client = Client()
    client.command(d.SET_MODE, 1, 6)
    client.command(d.ARM, 1)
    assert not client.all("STATUSTEXT")
    client.say(mavlink.MAVLink_heartbeat_message(d.GCS, d.NO_AUTOPILOT, 0, 0, 4, 3))
    client.command(d.ARM, 1)
    assert "no offboard signal" in client.all("STATUSTEXT")[0].text


def test_a_long_text_comes_in_pieces_and_is_joined() -> None:
    client = Client()
    client.say(mavlink.MAVLink_heartbeat_message(d.GCS, d.NO_AUTOPILOT, 0, 0, 4, 3))
    said = [
        "Arming denied: Resolve system health failures first, then try again",
        "Disarmed",
        "x" * 50 + " y" * 60,
    ]
    for text in said:
        client.vehicle._text(2, text)
    client.run(0.02)
    assert len(client.all("STATUSTEXT")) == 2 + 1 + 4
    telemetry = Telemetry()
    for message in client.heard:
        telemetry.take(message, 1.0)
    assert [t.text for t in telemetry.status.texts] == said


def test_the_heartbeat_takes_no_interval_but_comes_when_it_is_asked_for() -> None:
    client = Client()
    client.command(d.SET_INTERVAL, 0, 1e5)
    assert client.results(d.SET_INTERVAL) == [d.DENIED]
    before = len(client.all("HEARTBEAT"))
    client.command(d.REQUEST_MESSAGE, 0)
    assert len(client.all("HEARTBEAT")) == before + 1


def test_a_hundred_hertz_come_as_ninety_nine() -> None:
    client = Client()
    client.command(d.SET_INTERVAL, NUMBERS["ATTITUDE_QUATERNION"], 1e4)
    client.heard.clear()
    client.run(10.0)
    assert 985 <= len(client.all("ATTITUDE_QUATERNION")) <= 995


@pytest.mark.parametrize(("rate", "steps"), [(100.0, {8: 0.75, 16: 0.25}), (125.0, {8: 1.0})])
def test_its_estimate_is_new_every_8_ms_and_at_100_hz_one_in_five_is_left_out(
    rate: float, steps: dict[int, float]
) -> None:
    client = Client()
    client.command(d.SET_INTERVAL, NUMBERS["ODOMETRY"], 1e6 / rate)
    client.heard.clear()
    client.run(8.0)
    stamps = [m.time_usec for m in client.all("ODOMETRY")][2:]
    seen = Counter(round((b - a) / 1e3) for a, b in pairwise(stamps))
    assert {k: n / (len(stamps) - 1) for k, n in seen.items()} == pytest.approx(steps, abs=0.01)


@pytest.mark.parametrize(("thrust", "least", "most"), [(nan, 0.0, 0.0), (1.5, 0.9, 1.0)])
def test_setpoints_are_not_sanitised(thrust: float, least: float, most: float) -> None:
    client = Client()
    client.rates(0.0)
    client.command(d.SET_MODE, 1, 6)
    client.command(d.ARM, 1)
    assert client.vehicle.armed
    client.rates(thrust)
    client.run(0.02)
    assert all(least <= u <= most for u in client.vehicle.commands)


def test_it_tells_the_rates_that_it_follows_and_a_position_only_where_it_follows_one() -> None:
    world = _flying()
    reader, telemetry = Codec(245, 190), Telemetry()

    def told() -> list[Any]:
        telemetry.followed.clear()
        for data in world.vehicle.advance(world.vehicle.time + 0.2):
            for message in reader.unpack(data, world.vehicle.time):
                telemetry.take(message, world.vehicle.time)
        return [w for _, w in telemetry.followed]

    _sent(world, (0.3, -0.2, 0.1), 0.5)
    rates = told()
    assert rates == [pytest.approx((0.3, -0.2, 0.1), abs=1e-6)] * len(rates)
    assert len(rates) >= 9
    world.vehicle.set_mode(d.HOLD)
    assert None in told()


def test_rates_beyond_its_limits_are_flown() -> None:
    world = _flying()
    most = world.vehicle.parameters["MC_ROLLRATE_MAX"] * 3.1416 / 180.0
    for _ in range(20):
        _sent(world, (8.0, 0.0, 0.0), 0.5)
        world.vehicle.advance(world.vehicle.time + 0.01)
    assert world.body.w[0] > 1.2 * most


def test_the_last_rates_are_held_then_it_fails_over_and_returns_to_offboard_when_the_stream_does() -> None:
    world = _flying()
    vehicle = world.vehicle
    loss = vehicle.parameters["COM_OF_LOSS_T"]
    last = vehicle._setpoint
    vehicle.advance(vehicle.time + 0.9 * loss)
    assert vehicle.mode == d.OFFBOARD
    assert vehicle._setpoint is last
    vehicle.advance(vehicle.time + 0.2 * loss)
    assert vehicle.mode == d.LAND
    _sent(world, (0.0, 0.0, 0.0), 0.5)
    vehicle.advance(vehicle.time + 0.01)
    assert vehicle.mode == d.OFFBOARD


def test_velocity_of_odometry_is_in_the_local_frame() -> None:
    client = Client()
    client.vehicle.body.q = (0.7071, 0.0, 0.0, 0.7071)  # nose north
    client.vehicle.body.p, client.vehicle.body.on_ground = (0.0, 0.0, 5.0), False
    client.vehicle.body.v = (3.0, 0.0, 0.0)  # east
    client.command(d.SET_INTERVAL, NUMBERS["ODOMETRY"], 1e4)
    m = client.all("ODOMETRY")[0]
    assert frames.world((m.vx, m.vy, m.vz))[0] == pytest.approx(3.0, abs=0.2)


def test_the_motors_stand_still_for_a_moment_when_land_follows_offboard() -> None:
    world = _flying()
    vehicle = world.vehicle
    vehicle.set_mode(d.LAND)
    seen = []
    for _ in range(10):
        vehicle.advance(vehicle.time + 0.004)
        seen.append(max(vehicle.commands))
    assert min(seen) == 0.0
    assert seen[-1] > 0.2
    assert seen.count(0.0) <= 4
