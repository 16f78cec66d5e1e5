"""Over real sockets on the loopback interface: the link comes up, keeps to its vehicle and survives a flood."""

from __future__ import annotations

import random
import socket
import time

import pytest

from nsde_torch.px4.link.connection import Link
from nsde_torch.px4.link.transport import LinkError, UdpIn, UdpOut, open_transport
from nsde_torch.px4.simulator.autopilot import SimulatedAutopilot
from nsde_torch.px4.simulator.body import Body
from nsde_torch.px4.simulator.vehicle import Vehicle


def test_the_newest_state_comes_and_a_flood_of_rubbish_changes_nothing() -> None:
    ours = UdpIn("127.0.0.1", 0)
    autopilot = SimulatedAutopilot(Body("quadrotor", seed=0))
    rng = random.Random(0)
    rubbish = [rng.randbytes(200) for _ in range(50)]
    with Vehicle(autopilot, UdpOut(*ours.address)), Link(ours) as link:
        link.wait_for_vehicle(20.0)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as hostile:
            end = time.monotonic() + 1.5
            while time.monotonic() < end:
                for data in rubbish:
                    hostile.sendto(data, ours.address)
                time.sleep(0.005)
        state = link.endpoint.state
        assert state is not None
        assert link.now() - state.time < 1.0
        assert link.endpoint.telemetry.sync.round_trip is not None
        assert ours.foreign > 100
        assert link.fault is None


def test_no_vehicle_is_an_error_with_a_reason() -> None:
    with Link(UdpIn("127.0.0.1", 0)) as link, pytest.raises(LinkError, match="nothing was heard"):
        link.wait_for_vehicle(0.2)


@pytest.mark.parametrize("url", ["udpin:0.0.0.0:14540", "tcpin:192.168.1.2:4560", "udpin:[::]:14540"])
def test_listening_beyond_loopback_needs_a_word(url: str) -> None:
    with pytest.raises(LinkError, match=r"link.expose=true"):
        open_transport(url)


@pytest.mark.parametrize("url", ["", "udp", "udpin:127.0.0.1", "udpin:127.0.0.1:port", "foo:1.2.3.4:5"])
def test_a_url_that_is_not_understood_lists_what_is(url: str) -> None:
    with pytest.raises(LinkError, match="expected udpin"):
        open_transport(url)


def test_an_address_in_use_is_said() -> None:
    first = UdpIn("127.0.0.1", 0)
    try:
        with pytest.raises(LinkError, match="another program"):
            open_transport(f"udpin:127.0.0.1:{first.address[1]}")
    finally:
        first.close()
