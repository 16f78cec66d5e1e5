"""Flights on the simulated vehicle in virtual time: the same link, state machine and logs, and no waiting."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from nsde_torch.px4.flight.controller import FlightController
from nsde_torch.px4.flight.flying import FlightReport, fly
from nsde_torch.px4.flight.options import FlightOptions
from nsde_torch.px4.flight.path import PathPoints
from nsde_torch.px4.flight.runner import Inline
from nsde_torch.px4.flight.safety import Limits
from nsde_torch.px4.simulator.autopilot import SimulatedAutopilot
from nsde_torch.px4.simulator.body import Body
from nsde_torch.px4.simulator.virtual import VirtualLink

LINE = 0.005
"""Time that a message takes on the simulated line [s]."""
SOLVE = 0.01
"""Time after which a plan is there: a solve, rounded up to a tick of the loop [s]."""


def fly_simulated(
    body: Body,
    controller: FlightController,
    path: PathPoints,
    *,
    seed: int,
    period: float,
    sensor_noise: float = 1.0,
    limits: Limits | None = None,
    options: FlightOptions | None = None,
    log: Path | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> FlightReport:
    """Fly once, from the ground to the ground, in virtual time.

    Args:
        body: The machine, on the ground.
        controller: See `FlightController`.
        path: Where to fly, from the place of take-off.
        seed: Of the noise of the estimate.
        period: Time between plans [s].
        sensor_noise: Factor on that noise.
        limits: See `Limits`.
        options: See `FlightOptions`.
        log: File of the log; None: none.
        say: Takes a line about each step.

    Returns:
        What was measured; the same for the same seeds on every machine on which arithmetic is the same.
    """
    autopilot = SimulatedAutopilot(body, seed=seed, sensor_noise=sensor_noise)
    runner = Inline(controller, period=period, delay=SOLVE)
    with VirtualLink(autopilot, latency=LINE) as link:
        return fly(link, runner, path, motors=body.nu, log=log, limits=limits, options=options, say=say)
