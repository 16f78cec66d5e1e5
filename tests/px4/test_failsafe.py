"""What PX4 does when the stream ends is judged before anything is armed, with the line that sets it."""

import pytest

from nsde_torch.control import shapes
from nsde_torch.px4.flight.cascade import PathPoints
from nsde_torch.px4.flight.preflight import failsafe_faults, failsafe_warnings
from nsde_torch.px4.flight.safety import Limits, Phase
from nsde_torch.px4.options import FlightOptions
from tests.helpers.px4_world import World, under_way

FAST = PathPoints(shapes.lemniscate(duration=20.0))
SHORT = PathPoints(shapes.hover(duration=2.0, height=1.0))


def _killed(parameters: dict[str, float]) -> float:
    """Speed at which the ground is met after the link was cut in fast flight [m/s]."""
    world = under_way(Phase.TRACK, 4.0, path=FAST, parameters={"COM_RC_IN_MODE": 0.0})
    world.vehicle.parameters.update(parameters)  # some are refused before the flight
    for _ in range(1500):
        before = world.body.v
        for data in world.vehicle.advance(world.vehicle.time + 0.01):
            assert data
        if world.body.on_ground:
            return float(sum(c * c for c in before) ** 0.5)
    raise AssertionError("it never came down")


def test_a_flight_that_is_killed_drifts_into_the_ground_by_px4s_default_lands_with_4_and_falls_with_7() -> (
    None
):
    assert _killed({"COM_OBL_RC_ACT": 0.0}) > 3.0
    assert _killed({"COM_OBL_RC_ACT": 4.0}) < 1.2
    assert _killed({"COM_OBL_RC_ACT": 7.0}) > 4.0


def _sticks(action: float, sticks: float) -> dict[str, float]:
    return {"COM_OBL_RC_ACT": action, "COM_RC_IN_MODE": sticks}


def _only(said: str | None, found: list[str]) -> None:
    """That alone is said, or nothing."""
    assert len(found) == (said is not None)
    assert said is None or said in found[0]


@pytest.mark.parametrize(
    ("known", "said"),
    [
        (
            _sticks(0.0, 4.0),
            "PX4 goes to POSITION, which is flown with sticks, and COM_RC_IN_MODE is 4: there are",
        ),
        (_sticks(1.0, 4.0), "PX4 goes to ALTITUDE, which is flown with sticks"),
        (_sticks(2.0, 4.0), "`param set COM_OBL_RC_ACT 4` makes it land"),
        (_sticks(6.0, 1.0), "when the stream ends PX4 terminates the flight in the air"),
        (_sticks(7.0, 1.0), "when the stream ends PX4 disarms in the air"),
        (_sticks(0.0, 1.0), None),
        ({"NAV_RCL_ACT": 6.0}, "NAV_RCL_ACT is 6: when the transmitter is lost PX4 disarms in the air"),
        ({"NAV_RCL_ACT": 6.0, "COM_RC_IN_MODE": 4.0}, None),
        ({"NAV_RCL_ACT": 6.0, "COM_RCL_EXCEPT": 4.0}, None),
        ({"NAV_RCL_ACT": 6.0, "COM_RCL_EXCEPT": 3.0}, "`param set NAV_RCL_ACT 3` makes it land"),
        ({"NAV_DLL_ACT": 5.0}, "NAV_DLL_ACT is 5: when the ground station is lost PX4 terminates the flight"),
        ({"NAV_DLL_ACT": 5.0, "COM_DLL_EXCEPT": 4.0}, None),
        ({"GF_ACTION": 4.0}, "`param set GF_ACTION 5` makes it land"),
        ({"GF_ACTION": 2.0, "NAV_DLL_ACT": 0.0, "NAV_RCL_ACT": 3.0}, None),
    ],
)
def test_no_failsafe_may_stop_the_motors_in_the_air(known: dict[str, float], said: str | None) -> None:
    _only(said, failsafe_faults(known))


@pytest.mark.parametrize(
    ("known", "said"),
    [
        (
            {"NAV_RCL_ACT": 2.0, "RTL_RETURN_ALT": 30.0},
            "climbs to RTL_RETURN_ALT, 30 m, first; the fence ends",
        ),
        ({"NAV_RCL_ACT": 2.0, "RTL_RETURN_ALT": 2.5}, None),
        (_sticks(0.0, 1.0), "`param set COM_OBL_RC_ACT 4`"),
        ({"COM_OBL_RC_ACT": 3.0}, "RTL_RETURN_ALT"),
        ({"COM_OF_LOSS_T": 1.0}, "`param set COM_OF_LOSS_T 0.5`"),
        ({"COM_LOW_BAT_ACT": 3.0}, "`param set COM_LOW_BAT_ACT 2` makes it land"),
        ({"COM_LOW_BAT_ACT": 0.0}, "only warns of a low battery"),
        ({"COM_RC_OVERRIDE": 1.0}, "`param set COM_RC_OVERRIDE 3`"),
        ({"COM_RC_OVERRIDE": 1.0, "COM_RC_IN_MODE": 4.0}, None),
        ({"COM_RC_OVERRIDE": 2.0}, None),
        ({"GF_MAX_VER_DIST": 2.5}, "GF_MAX_VER_DIST is 2.5 m, and our fence reaches to 3 m"),
        ({"GF_MAX_HOR_DIST": 6.0}, "`param set GF_MAX_HOR_DIST 9` lets ours act first"),
        ({"GF_MAX_VER_DIST": 0.0, "GF_MAX_HOR_DIST": 20.0}, None),
        ({"EKF2_GPS_DELAY": 0.0}, "`param set EKF2_GPS_DELAY 110` is PX4's default"),
        ({"SENS_GPS0_DELAY": 0.0}, "SENS_GPS0_DELAY is 0 ms: no receiver is that fresh"),
        ({"SENS_GPS0_DELAY": 10.0}, None),
        ({"SDLOG_PROFILE": 1.0}, "`param set SDLOG_PROFILE 147`"),
        ({"SDLOG_PROFILE": 17.0}, None),
    ],
)
def test_what_px4_does_by_itself_is_told_where_it_may_end_badly(
    known: dict[str, float], said: str | None
) -> None:
    _only(said, failsafe_warnings(known, speed=3.0, top=3.0, reach=8.5))


@pytest.mark.parametrize("action", [4.0, 7.0])
def test_a_check_lists_everything_a_line_each_and_sends_no_setpoint(action: float) -> None:
    world = World(
        path=SHORT,
        options=FlightOptions(checks=1.0, only_check=True),
        limits=Limits(battery=0.95),
        parameters={"COM_OBL_RC_ACT": action, "COM_LOW_BAT_ACT": 0.0, "SDLOG_PROFILE": 1.0},
    )
    if action == 4.0:
        world.flight.limits = Limits()
    world.run()
    listed = [text.strip() for text in world.says]
    assert sum(text.startswith("note: COM_LOW_BAT_ACT is 0") for text in listed) == 1
    assert sum(text.startswith("note: SDLOG_PROFILE is 1") for text in listed) == 1
    refused = [text for text in listed if text.startswith("refused: ")]
    assert len(refused) == (2 if action == 7.0 else 0)
    assert (world.flight.outcome.trouble is None) == (action == 4.0)
    assert not world.setpoints
    assert not world.vehicle.armed


def test_a_good_set_for_the_reference_is_not_spoken_of() -> None:
    good = {"COM_OBL_RC_ACT": 4.0, "COM_RC_IN_MODE": 4.0, "COM_OF_LOSS_T": 0.5}
    good |= {"NAV_RCL_ACT": 2.0, "COM_LOW_BAT_ACT": 2.0, "RTL_RETURN_ALT": 30.0, "SDLOG_PROFILE": 147.0}
    assert failsafe_warnings(good, speed=3.4) == []
    assert failsafe_faults(good) == []
    assert failsafe_warnings({**good, "COM_OF_LOSS_T": 1.0}, speed=0.0) == []
    assert failsafe_faults({**good, "COM_OF_LOSS_T": 5.0})
    assert failsafe_faults({}) == failsafe_warnings({}, speed=9.0) == []
