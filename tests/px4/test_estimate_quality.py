"""What PX4's estimator says of itself (ESTIMATOR_STATUS): a flight on an estimate that its sensors contradict lands."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from math import inf, nan, radians
from types import SimpleNamespace

import pytest

from nsde_torch.control import shapes
from nsde_torch.px4.flight.flying import Recorder
from nsde_torch.px4.flight.options import FlightOptions, Limits
from nsde_torch.px4.flight.path import PathPoints
from nsde_torch.px4.flight.phases import Phase
from nsde_torch.px4.flight.safety import contradicted
from nsde_torch.px4.link.dialect import mavlink
from nsde_torch.px4.link.telemetry import EstimateQuality, Telemetry
from nsde_torch.px4.simulator.estimate import SimulatedEstimator
from nsde_torch.px4.simulator.sensor_errors import SensorErrors
from tests.helpers.px4_world import World

HOVER = PathPoints(shapes.hover(duration=4.0, height=1.0))
GOOD = EstimateQuality(0.0, 0.1, 0.2, 0.3, 0.4, 0.3, 0.4)


def _with(**changed: float) -> EstimateQuality:
    return EstimateQuality(**{**vars(GOOD), **changed})


@pytest.mark.parametrize(
    ("quality", "said"),
    [
        (GOOD, ""),
        (None, ""),
        (_with(velocity_ratio=1.2), "velocity innovation ratio is 1.20, more than 1"),
        (_with(position_ratio=7.0, velocity_ratio=2.0), "position innovation ratio is 7.00"),
        (_with(height_ratio=1.01), "height innovation ratio"),
        (_with(heading_ratio=9.0), ""),  # wrong by design until it is reset in the climb
        (
            _with(velocity_ratio=nan, position_ratio=nan, height_ratio=nan, horizontal_m=nan, vertical_m=nan),
            "",
        ),
        (_with(horizontal_m=1.6), "gives its position an error of 1.6 m, more than 1.5"),
        (_with(vertical_m=inf), ""),
        (_with(velocity_ratio=9.0, time=-3.0), ""),  # it no longer says anything
    ],
)
def test_what_an_estimator_says_against_itself_is_put_in_words(
    quality: EstimateQuality | None, said: str
) -> None:
    found = contradicted(quality, Limits(), 0.0)
    assert said in found
    assert bool(said) == bool(found)


def test_the_message_is_read_by_px4s_names() -> None:
    telemetry = Telemetry()
    telemetry.take(mavlink.MAVLink_estimator_status_message(0, 0, *range(1, 9)), 5.0)
    assert telemetry.status.quality == EstimateQuality(5.0, 1, 2, 3, 4, 7, 8)


@pytest.mark.parametrize(("lasts", "flown_on"), [(0.6, True), (9.0, False)])
def test_a_flight_lands_where_the_estimator_rejects_its_sensors_for_longer_than_a_second(
    lasts: float, flown_on: bool
) -> None:
    def doubt(world: World) -> None:
        t = world.flight._elapsed if world.phase is Phase.TRACK else 0.0
        world.vehicle.estimator.contradicted = 1.6 if 1.0 < t < 1.0 + lasts else 0.02

    world = World(path=HOVER).run(doubt)
    outcome = world.flight.outcome
    assert outcome.tracked == flown_on, world.says
    assert outcome.landed
    assert world.safe
    if not flown_on:
        assert outcome.trouble is not None
        assert outcome.trouble.kind == "quality"
        assert "innovation ratio is 1.60, more than 1: it may not be where it says" in outcome.trouble.text


def test_no_flight_begins_on_an_estimate_that_has_not_settled() -> None:
    world = World(path=HOVER, options=FlightOptions(checks=1.0))
    world.vehicle.estimator.contradicted = 0.7
    world.run()
    assert world.flight.outcome.trouble is not None
    assert "position innovation ratio is 0.70, more than 0.5" in world.flight.outcome.trouble.text
    assert not world.setpoints


def test_a_version_that_does_not_say_is_flown_with_a_note() -> None:
    def silent(data: bytes, now: float) -> list[tuple[float, bytes]]:
        said = int.from_bytes(data[7:10], "little") == mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS
        return [] if said else [(now, data)]

    world = World(path=HOVER, down=silent).run()
    assert world.flight.outcome.tracked
    assert any("note: ESTIMATOR_STATUS is not sent" in line for line in world.says)


def test_the_worst_in_flight_is_in_the_report() -> None:
    world = World(path=HOVER)
    recorder = Recorder(world.flight, None)

    def doubt(world: World) -> None:
        recorder.look(world.now)
        world.vehicle.estimator.contradicted = 0.8 if world.phase is Phase.TRACK else 0.02

    found = (world.run(doubt), recorder.finish().as_dict())[1]
    worst = found["estimator_worst"]
    assert worst["height_ratio"] == pytest.approx(0.8)
    assert (worst["horizontal_m"], worst["vertical_m"]) == pytest.approx((0.2, 0.2))
    assert "time" not in worst


def _astray(heading: float) -> Callable[[World], None]:
    """The heading goes wrong while the reference is flown, and no version resets it there."""

    def harm(world: World) -> None:
        if world.phase is Phase.TRACK and world.flight._elapsed > 2.0:
            world.vehicle.estimator.aligns, world.vehicle.estimator._error = False, radians(heading)

    return harm


@pytest.mark.parametrize(("heading", "flown_on"), [(20.0, True), (90.0, False)])
def test_a_wrong_heading_is_flown_with_or_landed_on(heading: float, flown_on: bool) -> None:
    """Horizontal loops bear 20 deg; by 90 deg every correction leads sideways."""
    path = PathPoints(shapes.circle(duration=16.0, speed=2.0))
    world = World(path=path).run(_astray(heading))
    assert world.safe, world.says
    assert world.flight.outcome.tracked == flown_on, world.says
    assert flown_on or world.flight.outcome.trouble is not None


def test_an_error_that_all_sensors_share_is_not_seen() -> None:
    """A receiver that drifts by a metre in five seconds: documented as unseen, and the flight ends a metre off."""

    def drift(world: World) -> None:
        if world.phase is Phase.TRACK:
            world.vehicle.estimator.offset = (min(0.2 * world.flight._elapsed, 1.0), 0.0, 0.0)

    world = World(path=PathPoints(shapes.hover(duration=8.0, height=1.0))).run(drift)
    assert world.flight.outcome.tracked, world.says
    assert world.errors[-1] == pytest.approx(1.0, abs=0.15)
    assert world.safe


def test_the_slow_error_of_a_poor_estimate_has_its_size_and_its_velocity_belongs_to_it() -> None:
    errors = SensorErrors(estimate=(0.2, 0.1, 0.45), estimate_time=0.5)
    estimator = SimulatedEstimator(std=(0.0,) * 4, seed=1, heading=0.0, errors=errors)
    still = SimpleNamespace(
        p=(0.0, 0.0, 1.0), v=(0.0,) * 3, q=(1.0, 0.0, 0.0, 0.0), w=(0.0,) * 3, dt=0.004, on_ground=False
    )
    rows = [estimator.sense(still)[:2] for _ in range(100_000)]  # type: ignore[arg-type]
    size = [(sum((p[k] - still.p[k]) ** 2 for p, _ in rows) / len(rows)) ** 0.5 for k in range(3)]
    assert size == pytest.approx([0.1, 0.2, 0.45], rel=0.25)  # ENU
    steps = sum(abs(b[0][0] - a[0][0] - 0.004 * a[1][0]) for a, b in pairwise(rows))
    assert steps / len(rows) < 0.004 * 2.0 * 0.1 / 0.5  # less than that error alone would move


def test_on_an_estimate_as_poor_as_of_sih_a_flight_goes_to_its_end() -> None:
    """The truth is off by that error, which neither PX4's estimator nor this program can see."""
    errors = SensorErrors(estimate=(0.2, 0.12, 0.45))
    world = World(path=PathPoints(shapes.circle(duration=16.0)), errors=errors).run()
    assert world.flight.outcome.tracked, world.says
    assert world.flight.outcome.landed
    assert world.safe
    assert 0.2 < world.rmse < 1.0
