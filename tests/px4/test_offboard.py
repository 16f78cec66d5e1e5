"""Flights that go well, in virtual time, and those that are refused with the autopilot's own words."""

from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from nsde_torch.control import shapes
from nsde_torch.control.shapes import waypoints
from nsde_torch.px4.flight import preflight
from nsde_torch.px4.flight.cascade import CascadeController, PathPoints
from nsde_torch.px4.flight.controller import Inline
from nsde_torch.px4.flight.flying import land
from nsde_torch.px4.flight.offboard import Offboard
from nsde_torch.px4.flight.safety import Limits, Phase
from nsde_torch.px4.link import dialect as d
from nsde_torch.px4.options import FlightOptions
from nsde_torch.px4.simulator.autopilot import SimulatedAutopilot
from nsde_torch.px4.simulator.body import Body
from nsde_torch.px4.simulator.simulated import VirtualLink
from tests.helpers.px4_world import World, under_way

ORDER = ["preflight", "stream", "offboard", "arm", "take off", "hold", "track", "return", "land"]


@pytest.mark.parametrize("system", ["quadrotor", "hexacopter"])
def test_a_flight_goes_through_its_steps_with_setpoints_at_a_hundred_hertz_until_it_lands(
    system: str,
) -> None:
    world = World(system=system, path=PathPoints(shapes.hover(duration=2.0, height=1.0))).until(Phase.STREAM)
    begun = world.now
    world.until(Phase.LAND)
    assert max(np.diff([begun, *(t for t in world.setpoints if t > begun), world.now])) < 0.021
    world.run()
    assert world.phases[: len(ORDER)] == ORDER
    assert world.flown, world.says
    assert world.rmse < 0.15
    landed = next(t for t, p, _ in world.flight.outcome.actions if p == "done")
    assert max(world.setpoints) < 1000.0 + landed - 1.0


def _to_the_end(world: World) -> World:
    """Runs until the flight is over, wherever the vehicle is then."""
    while not world.flight.done:
        world.tick()
    return world


@pytest.mark.parametrize(("come_back", "left"), [(True, 0.0), (False, 2.0)])
def test_a_flight_lands_where_its_reference_ends_or_where_it_took_off(come_back: bool, left: float) -> None:
    path = PathPoints(waypoints([[0.0, 0.0, 1.0], [2.0, 0.0, 0.6]], times=[0.0, 3.0]))
    options = FlightOptions(height=1.0, climb=1.2, hold=0.3, idle=0.4, spool=0.4, come_back=come_back)
    world = World(path=path, options=options).run()
    assert world.flown, world.says
    assert world.body.p[:2] == pytest.approx((left, 0.0), abs=0.3)


def test_hover_throttle_is_learned_from_a_wrong_parameter() -> None:
    world = World(parameters={"MPC_THR_HOVER": 0.6}).until(Phase.TRACK, 4.0)
    assert world.flight.hover.value == pytest.approx(world.body.hover_throttle(), rel=0.04)


def test_a_refusal_to_arm_is_explained_in_the_autopilots_words() -> None:
    world = World()
    world.until(Phase.OFFBOARD)
    world.body.used = 0.95
    world.run()
    assert "arming was refused" in world.trouble.text
    assert "low battery" in world.trouble.text
    assert world.safe


def test_flying_is_refused_before_arming_with_every_reason() -> None:
    world = World(
        path=PathPoints(shapes.circle(radius=9.0)),
        parameters={"COM_OF_LOSS_T": 5.0},
        options=FlightOptions(checks=2.0),
        limits=Limits(battery=0.95),
    ).run()
    trouble = world.flight.outcome.trouble
    for reason in ("leaves the fence", "COM_OF_LOSS_T", "charge it"):
        assert reason in trouble.text
    assert not world.setpoints


def _near_the_top(path: float = 1.0, height: float = 1.0, climb: float = 0.8) -> World:
    options = FlightOptions(height=height, climb=climb, hold=0.3, idle=0.4, spool=0.4, checks=1.0)
    fence = Limits(fence=((-6.0, 6.0), (-6.0, 6.0), (-0.5, 1.8)))
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
    assert said in world.trouble.text
    assert not world.setpoints


def test_without_a_vehicle_the_flight_says_that_nothing_was_heard() -> None:
    world = World(down=lambda data, now: [], options=FlightOptions(connect=1.0)).run()
    assert "nothing was heard" in world.trouble.text


@pytest.mark.parametrize("flies", [False, True])
def test_an_armed_vehicle_is_left_alone_and_only_on_the_ground_it_is_to_be_disarmed(flies: bool) -> None:
    world = World(options=FlightOptions(checks=1.5))
    world.vehicle.armed = True
    world.vehicle.parameters["COM_DISARM_PRFLT"] = -1.0
    if flies:
        world.body.p, world.body.on_ground = (0.0, 0.0, 2.0), False
        world.vehicle.estimate = (world.body.p, *world.vehicle.estimate[1:])
        world.vehicle.set_mode(d.POSITION)
    said = _to_the_end(world).trouble.text
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
    world = under_way(Phase.STREAM)
    status = replace(world.endpoint.telemetry.status, armed=armed, landed=landed)
    moving = replace(world.endpoint.state, v=(speed, 0.0, 0.0))
    given = (world.endpoint, status, moving, world.path, Limits())
    found = preflight.faults(*given, options=world.options, now=world.now)
    told = [line for line in found if line.startswith("the vehicle is")]
    assert len(told) == (said is not None)
    if said is not None:
        assert said in told[0]
        assert "disarm it" not in told[0].replace("do not disarm it", "") or landed == d.ON_GROUND


def _left_in_hold() -> World:
    return deepcopy(_world_left_in_hold())


@cache
def _world_left_in_hold() -> World:
    """A vehicle in the air whose flight was ended by somebody who chose HOLD, and a flight that takes it over."""
    world = World(path=PathPoints(shapes.hover(duration=2.0, height=1.0))).until(Phase.TRACK, 1.0)
    world.flight.options = replace(world.options, watch=0.5)
    world.vehicle.set_mode(d.HOLD)
    _to_the_end(world)
    runner, takeover = (
        Inline(CascadeController(world.path)),
        replace(world.options, takeover=True, checks=1.0),
    )
    world.flight = Offboard(world.endpoint, runner, world.path, options=takeover, say=world.says.append)
    return world


def test_a_vehicle_that_was_left_in_hold_is_taken_over_and_flown_about_where_it_took_off() -> None:
    world = _left_in_hold()
    world.vehicle.home = (1.0, -0.5, 0.0)
    lowest = world.body.p[2]
    while world.phase is not Phase.TRACK:
        world.tick()
        assert not world.flight.done, world.says
        lowest = min(lowest, world.body.p[2])
    assert lowest > 0.8  # it does not fall between two modes
    assert world.vehicle.armed
    world.errors.clear()
    world.run()
    assert world.phases[1:6] == ["stream", "offboard", "hold", "track", "return"]
    assert world.flown, world.says
    assert world.flight.outcome.begun
    assert world.rmse < 0.2
    assert world.safe
    assert world.body.p[:2] == pytest.approx((1.0, -0.5), abs=0.3)


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("no place of take-off", "PX4 does not tell where it took off (HOME_POSITION)"),
        ("a pilot", "the mode is POSITION, in which somebody may fly it"),
        ("beyond the fence", "it is outside the fence"),
        ("on the ground", "takeover=true is for a vehicle in the air, and this one is not"),
    ],
)
def test_only_a_vehicle_in_the_air_that_nobody_flies_is_taken_over(what: str, said: str) -> None:
    world = _left_in_hold()
    if what == "no place of take-off":
        world.vehicle.home = None
    elif what == "a pilot":
        world.vehicle.set_mode(d.POSITION)
    elif what == "beyond the fence":
        world.vehicle.home = (9.0, 0.0, 0.0)
    else:
        world = World(options=FlightOptions(takeover=True, checks=1.0))
    flown = len(world.setpoints)
    assert said in _to_the_end(world).trouble.text
    assert len(world.setpoints) == flown


def test_a_mode_that_is_chosen_before_the_takeover_is_left_alone() -> None:
    world = _left_in_hold().until(Phase.STREAM, 0.1)
    world.vehicle.set_mode(d.POSITION)
    _to_the_end(world)
    assert world.vehicle.mode == d.POSITION
    assert "the operator chose POSITION" in world.trouble.text


def _flying_link() -> tuple[VirtualLink, SimulatedAutopilot]:
    """A vehicle at 2 m in HOLD, and a link to it."""
    body = Body("quadrotor", seed=0)
    vehicle = SimulatedAutopilot(body, seed=0)
    link = VirtualLink(vehicle)
    link.pause(2.0)
    body.p, body.on_ground, vehicle.armed = (0.0, 0.0, 2.0), False, True
    link.pause(0.01)
    vehicle.set_mode(d.LAND)  # where it is, as its estimator has it
    vehicle.set_mode(d.HOLD)
    link.pause(1.0)
    return link, vehicle


def test_a_vehicle_that_nobody_flies_is_landed_without_a_setpoint() -> None:
    link, vehicle = _flying_link()
    outcome = land(link)
    assert outcome.landed
    assert outcome.trouble is None
    assert vehicle.body.on_ground
    assert not vehicle.armed
    assert vehicle._setpoint is None


@pytest.mark.parametrize(
    ("what", "kind", "said"),
    [
        ("on the ground", "refused", "the vehicle is disarmed"),
        ("nobody", "refused", "nothing was heard"),
        ("a pilot", "mode", "the mode is POSITION: whoever chose it has the vehicle"),
        ("not obeyed", "mode", "LAND was not confirmed, the mode is HOLD"),
        ("dead", "link", "the link is dead"),
    ],
)
def test_a_landing_that_is_not_seen_says_why_and_fights_nobody(
    what: str, kind: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    link, vehicle = _flying_link()
    if what == "on the ground":
        vehicle.armed = False
        link.pause(0.5)
    elif what == "nobody":
        link = VirtualLink(vehicle)
        vehicle.mute = True
    elif what == "not obeyed":
        monkeypatch.setattr(vehicle, "_command_mode", lambda m: (d.DENIED, ""))
    wait, begun = link.pause, link.now()

    def harm(seconds: float) -> None:
        wait(seconds)
        if link.now() > begun + 1.5:
            vehicle.mute = vehicle.mute or what == "dead"
            if what == "a pilot":
                vehicle.set_mode(d.POSITION)

    monkeypatch.setattr(link, "pause", harm)
    outcome = land(link, options=FlightOptions(connect=1.0))
    assert outcome.trouble.kind == kind
    assert said in outcome.trouble.text
    assert not outcome.landed
    assert (vehicle.mode == d.POSITION) == (what == "a pilot")
