"""Does a minute of hostile MAVLink bytes delay the loop that flies?

A vehicle in a process of its own is flown by the cascade over UDP, twice: as it is, and while hostile datagrams come
among the vehicle's own, from its own address, so that no rule about addresses helps. Reported are times between
setpoints and ages of states at them, in both.

    python benchmarks/bench_link_fuzz.py --seconds 60 --rate 2000
"""

import multiprocessing
import socket
import time
from typing import Any

from common import options

from nsde_torch.control import shapes
from nsde_torch.px4.flight.cascade import CascadeController, PathPoints
from nsde_torch.px4.flight.controller import Inline
from nsde_torch.px4.flight.flying import fly
from nsde_torch.px4.link.connection import Transport, UdpOut, open_link
from nsde_torch.px4.simulator.autopilot import SimulatedAutopilot
from nsde_torch.px4.simulator.body import Body
from nsde_torch.px4.simulator.simulated import Vehicle
from tests.helpers.fuzzed import hostile


class _Noisy(Transport):
    """A transport that says hostile things too."""

    def __init__(self, inner: Transport, rate: float) -> None:
        self._inner, self._rate, self._source = inner, rate, hostile(seed=0)
        self._due = time.monotonic() + 3.0  # the vehicle introduces itself first
        self.sent = 0

    def receive(self, timeout: float) -> bytes:
        while self._rate > 0 and time.monotonic() > self._due:
            self._inner.send(next(self._source))
            self._due += 1.0 / self._rate
            self.sent += 1
        return self._inner.receive(timeout)

    def send(self, data: bytes) -> None:
        self._inner.send(data)

    def close(self) -> None:
        self._inner.close()


def _vehicle(port: int, rate: float, stop: Any, sent: Any) -> None:
    transport = _Noisy(UdpOut("127.0.0.1", port), rate)
    autopilot = SimulatedAutopilot(Body("quadrotor", seed=0, latency=0.02))
    Vehicle(autopilot, transport).run(stop.is_set)
    sent.value = transport.sent


def flight(seconds: float, rate: float) -> dict[str, Any]:
    context = multiprocessing.get_context("spawn")
    stop, sent = context.Event(), context.Value("q", 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    process = context.Process(target=_vehicle, args=(port, rate, stop, sent), daemon=True)
    process.start()
    try:
        path = PathPoints(shapes.hover(duration=seconds))
        with open_link(f"udpin:127.0.0.1:{port}") as link:
            link.wait_for_vehicle(60.0)
            report = fly(link, Inline(CascadeController(path)), path, motors=4)
    finally:
        stop.set()
        process.join(10.0)
    return {**report.as_dict(), "hostile": sent.value}


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="length of each flight")
    parser.add_argument("--rate", type=float, default=2000.0, help="hostile datagrams in a second")
    arguments = parser.parse_args()
    for name, rate in (("without", 0.0), ("with", arguments.rate)):
        r = flight(arguments.seconds, rate)
        gap, age = r["setpoint_gap_ms"], r["state_age_ms"]
        gaps = " ".join(f"{key} {gap[key]:.2f}" for key in ("p50", "p99", "p99.9", "max"))
        ages = " ".join(f"{key} {age[key]:.2f}" for key in ("p50", "p99"))
        flown = f"hostile {r['hostile']:7d}  tracked {r['tracked']}  RMSE {100 * (r['rmse_m'] or 0):.1f} cm"
        print(f"{name:8s} {flown}  gaps [ms] {gaps}  ages [ms] {ages}  frames {r['frames']}", flush=True)


if __name__ == "__main__":
    main()
