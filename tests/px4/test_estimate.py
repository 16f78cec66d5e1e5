"""The vehicle's estimate: what its estimator says of itself (ESTIMATOR_STATUS), and its resets, one in every flight."""

from itertools import pairwise
from math import degrees, inf, nan, radians
from pathlib import Path

import numpy as np
import pytest

from nsde_torch.control import shapes
from nsde_torch.px4.flight.cascade import PathPoints
from nsde_torch.px4.flight.flight_log import FlightLog
from nsde_torch.px4.flight.flying import Recorder
from nsde_torch.px4.flight.safety import Phase, contradicted
from nsde_torch.px4.link.dialect import mavlink
from nsde_torch.px4.link.telemetry import EstimateQuality
from nsde_torch.px4.link.vectors import yaw_of
from nsde_torch.px4.options import FlightOptions, Limits
from nsde_torch.recording import read
from nsde_torch.systems import make_system
from tests.helpers.px4_world import World, under_way

CIRCLE = PathPoints(shapes.circle(duration=9.0, ramp=3.0, speed=2.0))
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
        (EstimateQuality(0.0, *[nan] * 6), ""),
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


@pytest.mark.parametrize(("lasts", "flown_on"), [(0.6, True), (9.0, False)])
def test_a_flight_lands_where_the_estimator_rejects_its_sensors_for_longer_than_a_second(
    lasts: float, flown_on: bool
) -> None:
    def doubt(world: World) -> None:
        t = world.flight._elapsed if world.phase is Phase.TRACK else 0.0
        world.vehicle.estimator.contradicted = 1.6 if 1.0 < t < 1.0 + lasts else 0.02

    world = World(path=HOVER).run(doubt)
    assert world.flight.outcome.tracked == flown_on, world.says
    assert world.flight.outcome.landed
    assert world.safe
    if not flown_on:
        world.ended("quality", "innovation ratio is 1.60, more than 1: it may not be where it says")


def test_no_flight_begins_on_an_estimate_that_has_not_settled() -> None:
    world = World(path=HOVER, options=FlightOptions(checks=1.0))
    world.vehicle.estimator.contradicted = 0.7
    world.run()
    assert "position innovation ratio is 0.70, more than 0.5" in world.trouble.text
    assert not world.setpoints


def test_a_version_that_does_not_say_is_flown_with_a_note() -> None:
    def silent(data: bytes, now: float) -> list[tuple[float, bytes]]:
        said = int.from_bytes(data[7:10], "little") == mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS
        return [] if said else [(now, data)]

    world = World(path=HOVER, down=silent).run()
    assert world.flight.outcome.tracked
    assert any("note: ESTIMATOR_STATUS is not sent" in line for line in world.says)


@pytest.mark.parametrize(("heading", "flown_on"), [(20.0, True), (90.0, False)])
def test_a_wrong_heading_is_flown_with_or_landed_on(heading: float, flown_on: bool) -> None:
    """Horizontal loops bear 20 deg; by 90 deg every correction leads sideways."""
    world = under_way(Phase.TRACK, 2.0, path=CIRCLE)
    world.vehicle.estimator.aligns, world.vehicle.estimator._error = False, radians(heading)
    world.run()
    assert world.safe, world.says
    assert world.flight.outcome.tracked == flown_on, world.says
    assert flown_on or world.flight.outcome.trouble is not None


HIGH = PathPoints(shapes.hover(duration=2.5, height=1.5))


def test_a_flight_at_default_height_goes_on_over_the_reset_of_the_heading() -> None:
    error = -8.9
    world = World(path=HIGH, options=FlightOptions(), heading_error=radians(error))
    yaws: list[tuple[float, float]] = []
    world.run(lambda w: yaws.append((w.body.p[2], degrees(yaw_of(w.body.q)))))
    assert world.flown, world.says
    ((_, step),) = world.flight.outcome.steps
    assert degrees(step.heading) == pytest.approx(-error, abs=1.0)
    assert step.announced
    assert any("heading" in line for line in world.says)
    # what was held is held as it is: the vehicle does not turn by the step
    held = [yaw for z, yaw in yaws if z > 1.0]
    before = next(yaw for z, yaw in yaws if z > 1.4)
    assert max(abs(yaw - before) for yaw in held[:300]) < 2.0


@pytest.mark.parametrize(("kind", "by"), [("position", 0.2), ("velocity", 0.8)])
def test_small_resets_of_position_and_velocity_are_noted_and_flown_through(kind: str, by: float) -> None:
    world = under_way(Phase.TRACK, 0.5, path=HIGH, heading_error=0.0)
    if kind == "position":
        world.body.p = (world.body.p[0] + by, *world.body.p[1:])
    else:
        world.body.v = (world.body.v[0] + by, *world.body.v[1:])
    world.vehicle.estimator.resets += 1
    world.run()
    assert world.flight.outcome.tracked, world.says
    step = world.flight.outcome.steps[-1][1]
    # of a velocity 30 m/s2 may be thrust, in the 8 or 16 ms between two states
    assert getattr(step, kind) == pytest.approx(by if kind == "position" else 0.44, abs=0.14)


def test_the_log_is_cut_at_a_reset_so_that_no_model_must_explain_it(tmp_path: Path) -> None:
    world = World(path=HIGH, heading_error=radians(8.0))
    with FlightLog(tmp_path / "flight_0.csv", 4) as log:
        recorder = Recorder(world.flight, log)
        world.run(lambda w: recorder.look(w.now))
    run = read("csv", make_system("quadrotor"), path=tmp_path).runs[0]
    assert len(run.segments) == 2
    for a, b in run.segments:
        q = run.x[a:b, 6:10]
        yaw = np.unwrap(
            np.arctan2(2 * (q[:, 0] * q[:, 3] + q[:, 1] * q[:, 2]), 1 - 2 * (q[:, 2:] ** 2).sum(1))
        )
        assert max(abs(d - c) for c, d in pairwise(np.degrees(yaw))) < 2.0
    (noted,) = recorder.finish().as_dict()["estimate_resets"]
    assert noted["heading_deg"] == pytest.approx(-8.0, abs=1.0)
