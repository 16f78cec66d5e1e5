"""What `nsde fly` and `nsde close-loop by=link` say of how a flight ended."""

from __future__ import annotations

import pytest

from nsde_torch.cli.exit_status import FLIGHT_ENDED, INTERRUPTED, NOT_LANDED, EndedError
from nsde_torch.cli.link_build import check_end
from nsde_torch.px4.flight.phases import FlightOutcome, Phase
from nsde_torch.px4.flight.safety import Action, Trouble
from nsde_torch.px4.link.transport import LinkError
from tests.helpers.px4_world import World


def _ended(kind: str | None, *, landed: bool = True) -> FlightOutcome:
    trouble = None if kind is None else Trouble(kind, "so it was", Action.LAND)
    return FlightOutcome(tracked=kind is None, landed=landed, trouble=trouble, actions=[(3.0, "arm", "")])


@pytest.mark.parametrize(
    "kind", [None, "fence", "speed", "tilt", "tracking", "tipped", "solver", "battery", "estimate"]
)
def test_a_flight_of_ours_that_stands_may_be_followed_by_another(kind: str | None) -> None:
    check_end(_ended(kind))
    with pytest.raises(EndedError, match="NOT seen to land") as error:
        check_end(_ended(kind, landed=False))
    assert error.value.status == NOT_LANDED


@pytest.mark.parametrize("kind", ["mode", "setpoints", "disarmed", "link", "late"])
def test_a_vehicle_that_was_taken_from_us_is_looked_at_first(kind: str) -> None:
    with pytest.raises(EndedError, match="went wrong, and landed: so it was") as error:
        check_end(_ended(kind))
    assert error.value.status == FLIGHT_ENDED


def test_a_refusal_is_the_users_to_mend() -> None:
    with pytest.raises(LinkError, match="so it was"):
        check_end(_ended("refused", landed=False))


_GROUND, _AIR = "stopped before it began", "was stopped, and landed"


@pytest.mark.parametrize(
    ("phase", "said"),
    [(Phase.STREAM, _GROUND), (Phase.OFFBOARD, _GROUND), (Phase.TAKEOFF, _AIR), (Phase.HOLD, _AIR)],
)
def test_ctrl_c_is_an_interruption_whenever_it_comes(phase: Phase, said: str) -> None:
    world = World().until(phase)
    world.flight.stop()
    world.run()
    assert world.safe
    with pytest.raises(EndedError, match=said) as error:
        check_end(world.flight.outcome)
    assert error.value.status == INTERRUPTED
