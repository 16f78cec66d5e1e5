"""What PX4 does when the stream ends is judged before anything is armed, with the line that sets it."""

from __future__ import annotations

import pytest

from nsde_torch.control import shapes
from nsde_torch.px4.flight import failsafe
from nsde_torch.px4.flight.options import FlightOptions
from nsde_torch.px4.flight.path import PathPoints
from nsde_torch.px4.flight.phases import Phase
from tests.helpers.px4_world import World

FAST = PathPoints(shapes.lemniscate(duration=20.0))
SHORT = PathPoints(shapes.hover(duration=2.0, height=1.0))


def _killed(parameters: dict[str, float]) -> float:
    """Speed at which the ground is met after the link was cut in fast flight [m/s]."""
    world = World(path=FAST, parameters={"COM_RC_IN_MODE": 0.0}).until(Phase.TRACK, 6.0)
    world.vehicle.parameters.update(parameters)  # some are refused before the flight
    for _ in range(1500):
        before = world.body.v
        for data in world.vehicle.advance(world.vehicle.time + 0.01):
            assert data
        if world.body.on_ground:
            return float(sum(c * c for c in before) ** 0.5)
    raise AssertionError("it never came down")


def test_with_px4s_default_a_flight_that_is_killed_drifts_into_the_ground_and_with_4_it_lands() -> None:
    assert _killed({"COM_OBL_RC_ACT": 0.0}) > 3.0
    assert _killed({"COM_OBL_RC_ACT": 4.0}) < 1.2


def _refused(action: float, sticks: float) -> str:
    """Why a flight is refused before a setpoint leaves."""
    world = World(
        path=SHORT,
        options=FlightOptions(checks=1.0),
        parameters={"COM_OBL_RC_ACT": action, "COM_RC_IN_MODE": sticks},
    ).run()
    trouble = world.flight.outcome.trouble
    assert trouble is not None
    assert trouble.kind == "refused"
    assert not world.setpoints
    return trouble.text


@pytest.mark.parametrize("action", [0.0, 1.0, 2.0])
def test_flying_is_refused_where_nobody_could_take_over(action: float) -> None:
    assert "`param set COM_OBL_RC_ACT 4`" in _refused(action, sticks=4.0)


@pytest.mark.parametrize(("action", "what"), [(6.0, "terminates the flight"), (7.0, "disarms")])
def test_flying_is_refused_where_px4_would_stop_the_motors_in_the_air(action: float, what: str) -> None:
    text = _refused(action, sticks=1.0)
    assert f"COM_OBL_RC_ACT is {action:g}: when the stream ends PX4 {what} in the air" in text
    assert "`param set COM_OBL_RC_ACT 4` makes it land; 5 holds, 3 returns" in text


def test_a_flight_that_is_killed_falls_where_px4_stops_the_motors() -> None:
    assert _killed({"COM_OBL_RC_ACT": 7.0}) > 4.0


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"COM_OBL_RC_ACT": 0.0, "COM_RC_IN_MODE": 1.0}, "`param set COM_OBL_RC_ACT 4`"),
        ({"COM_OBL_RC_ACT": 3.0}, "RTL_RETURN_ALT"),
        ({"COM_OF_LOSS_T": 1.0}, "`param set COM_OF_LOSS_T 0.5`"),
    ],
)
def test_what_may_end_badly_is_said_with_the_line_that_mends_it(
    parameters: dict[str, float], said: str
) -> None:
    world = World(path=FAST, parameters=parameters).until(Phase.STREAM)
    assert any(said in text for text in world.says), world.says


def test_a_good_set_for_the_reference_is_not_spoken_of() -> None:
    good = {"COM_OBL_RC_ACT": 4.0, "COM_RC_IN_MODE": 4.0, "COM_OF_LOSS_T": 0.5}
    assert failsafe.warnings(good, speed=3.4) == []
    assert failsafe.faults(good) == []
    assert failsafe.warnings({**good, "COM_OF_LOSS_T": 1.0}, speed=0.0) == []
    assert failsafe.faults({**good, "COM_OF_LOSS_T": 5.0})
    assert failsafe.faults({}) == failsafe.warnings({}, speed=9.0) == []
