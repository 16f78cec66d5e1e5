"""Flights that go well, in virtual time, and those that are refused with the autopilot's own words."""

from __future__ import annotations

from dataclasses import replace

import pytest

from nsde_torch.control import shapes
from nsde_torch.control.waypoints import waypoints
from nsde_torch.px4.flight import preflight
from nsde_torch.px4.flight.options import FlightOptions
from nsde_torch.px4.flight.path import PathPoints
from nsde_torch.px4.flight.phases import Phase
from nsde_torch.px4.flight.safety import Limits
from nsde_torch.px4.link import dialect as d
from tests.helpers.px4_world import World, delayed, lossy

ORDER = ["preflight", "stream", "offboard", "arm", "take off", "hold", "track", "return", "land"]


@pytest.mark.parametrize("system", ["quadrotor", "hexacopter"])
def test_a_flight_goes_through_its_steps_and_ends_on_the_ground_disarmed(system: str) -> None:
    world = World(system=system, path=PathPoints(shapes.hover(duration=2.0, height=1.0))).run()
    assert world.phases[: len(ORDER)] == ORDER
    assert world.flight.outcome.tracked
    assert world.flight.outcome.landed
    assert world.flight.outcome.trouble is None
    assert world.safe
    assert world.rmse < 0.15


def test_the_supplements_circle_is_flown_within_a_quarter_of_a_metre_at_its_speed() -> None:
    world = World(path=PathPoints(shapes.circle(duration=16.0))).run()
    assert world.flight.outcome.tracked, world.says
    assert world.rmse < 0.25


@pytest.mark.parametrize(("come_back", "left"), [(True, 0.0), (False, 2.0)])
def test_a_flight_lands_where_its_reference_ends_or_where_it_took_off(come_back: bool, left: float) -> None:
    path = PathPoints(waypoints([[0.0, 0.0, 1.0], [2.0, 0.0, 0.6]], times=[0.0, 3.0]))
    options = FlightOptions(height=1.0, climb=1.2, hold=0.3, idle=0.4, spool=0.4, come_back=come_back)
    world = World(path=path, options=options).run()
    assert world.flight.outcome.tracked, world.says
    assert world.flight.outcome.landed
    assert world.safe
    assert world.body.p[:2] == pytest.approx((left, 0.0), abs=0.3)


def test_setpoints_come_at_a_hundred_hertz_from_stream_to_landing() -> None:
    world = World(path=PathPoints(shapes.hover(duration=1.0, height=1.0))).until(Phase.STREAM)
    begun = world.now
    world.until(Phase.LAND)
    assert world.stream_gap(begun, world.now) < 0.021


def test_nothing_is_streamed_after_landing() -> None:
    world = World(path=PathPoints(shapes.hover(duration=1.0, height=1.0))).run()
    landed = next(t for t, p, _ in world.flight.outcome.actions if p == "done")
    assert max(world.setpoints) < 1000.0 + landed - 1.0


def test_hover_throttle_is_learned_from_a_wrong_parameter() -> None:
    world = World(parameters={"MPC_THR_HOVER": 0.6}, path=PathPoints(shapes.hover(duration=6.0, height=1.0)))
    world.until(Phase.TRACK, 5.0)
    assert world.flight.hover.value == pytest.approx(world.body.hover_throttle(), rel=0.04)


def test_a_line_with_delays_and_losses_in_both_directions_is_good_enough() -> None:
    world = World(
        path=PathPoints(shapes.hover(duration=3.0, height=1.0)),
        down=delayed(0.0, 0.03),
        up=lossy(0.05, seed=3),
        seed=2,
    ).run()
    assert world.flight.outcome.tracked, world.says
    assert world.safe


def test_a_refusal_to_arm_is_explained_in_the_autopilots_words() -> None:
    world = World()
    world.until(Phase.OFFBOARD)
    world.body.used = 0.95
    world.run()
    assert world.flight.outcome.trouble is not None
    assert "arming was refused" in world.flight.outcome.trouble.text
    assert "low battery" in world.flight.outcome.trouble.text
    assert world.safe


def test_flying_is_refused_before_arming_with_every_reason() -> None:
    world = World(
        path=PathPoints(shapes.circle(radius=9.0)),
        parameters={"COM_OF_LOSS_T": 5.0},
        options=FlightOptions(checks=2.0),
        limits=Limits(battery=0.95),
    ).run()
    trouble = world.flight.outcome.trouble
    assert trouble is not None
    for reason in ("leaves the fence", "COM_OF_LOSS_T", "charge it"):
        assert reason in trouble.text
    assert not world.setpoints


def _near_the_top(path: float = 1.0, height: float = 1.0, climb: float = 0.8, top: float = 1.8) -> World:
    options = FlightOptions(height=height, climb=climb, hold=0.3, idle=0.4, spool=0.4, checks=1.0)
    fence = Limits(fence=((-6.0, 6.0), (-6.0, 6.0), (-0.5, top)))
    reference = PathPoints(shapes.hover(duration=1.0, height=path))
    return World(path=reference, options=options, limits=fence).run()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"height": 1.7}, "Keep 0.44 m: a take-off (height) to 1.36 m at most, a slower climb, or a fence"),
        ({"climb": 2.0}, "Keep 1.1 m: a take-off (height) to 0.7 m at most"),
        ({"path": 1.7}, "Keep 0.3 m: a reference up to 1.5 m, or a fence (limits.fence) up to 2 m"),
    ],
)
def test_what_comes_near_the_fences_top_is_refused_before_arming_with_the_room_that_it_needs(
    given: dict[str, float], said: str
) -> None:
    world = _near_the_top(**given)
    assert world.flight.outcome.trouble is not None
    assert said in world.flight.outcome.trouble.text
    assert not world.setpoints


def test_with_that_room_a_take_off_and_a_reference_stay_below_the_fences_top() -> None:
    world = _near_the_top(path=1.5, height=1.36)
    assert world.flight.outcome.tracked, world.says
    assert 1.36 < world.highest < 1.8


def test_without_a_vehicle_the_flight_says_that_nothing_was_heard() -> None:
    world = World(down=lambda data, now: [], options=FlightOptions(connect=1.0)).run()
    assert world.flight.outcome.trouble is not None
    assert "nothing was heard" in world.flight.outcome.trouble.text


@pytest.mark.parametrize("flies", [False, True])
def test_an_armed_vehicle_is_left_alone_and_only_on_the_ground_it_is_to_be_disarmed(flies: bool) -> None:
    world = World(options=FlightOptions(checks=1.5))
    world.vehicle.armed = True
    world.vehicle.parameters["COM_DISARM_PRFLT"] = -1.0
    if flies:
        world.body.p, world.body.on_ground = (0.0, 0.0, 2.0), False
        world.vehicle.estimate = (world.body.p, *world.vehicle.estimate[1:])
        world.vehicle.set_mode(d.POSITION)
    while not world.flight.done:
        world.tick()
    assert world.flight.outcome.trouble is not None
    said = world.flight.outcome.trouble.text
    assert "armed already" in said
    assert ("on the ground: disarm it" in said) != flies
    assert ("do not disarm it. Take it over" in said) == flies
    assert not world.setpoints
    assert world.vehicle.armed
    assert world.vehicle.mode == (d.POSITION if flies else d.HOLD)


@pytest.mark.parametrize(
    ("armed", "landed", "speed", "said"),
    [
        (True, d.ON_GROUND, 0.0, "armed already, on the ground: disarm it"),
        (True, d.ON_GROUND, 1.0, "but moves: it may be flying, so do not disarm it"),
        (True, d.IN_AIR, 0.0, "says that it is in the air: it may be flying, so do not disarm it"),
        (True, d.LANDING, 0.0, "says that it is landing: it may be flying, so do not disarm it"),
        (True, 0, 0.0, "does not say whether it is on the ground: it may be flying, so do not disarm it"),
        (False, d.IN_AIR, 0.0, "disarmed and says that it is in the air: wait until"),
        (False, d.ON_GROUND, 0.0, None),
        (False, 0, 0.0, None),
    ],
)
def test_what_may_be_flying_is_to_be_taken_over_and_landed_and_never_disarmed(
    armed: bool, landed: int, speed: float, said: str | None
) -> None:
    world = World().until(Phase.STREAM)
    state = world.endpoint.state
    assert state is not None
    status = replace(world.endpoint.telemetry.status, armed=armed, landed=landed)
    moving = replace(state, v=(speed, 0.0, 0.0))
    found = preflight.faults(
        world.endpoint, status, moving, world.path, Limits(), options=world.options, now=world.now
    )
    told = [line for line in found if line.startswith("the vehicle is")]
    assert len(told) == (said is not None)
    if said is not None:
        assert said in told[0]
        assert "disarm it" not in told[0].replace("do not disarm it", "") or landed == d.ON_GROUND
