"""Landing a vehicle that is in the air, whoever flew it there: PX4's own LAND mode, watched until it is disarmed."""

from __future__ import annotations

from collections.abc import Callable
from math import inf

from nsde_torch.px4.flight.options import FlightOptions
from nsde_torch.px4.flight.phases import REFUSED, FlightOutcome, Phase
from nsde_torch.px4.flight.safety import Action, Trouble
from nsde_torch.px4.link import dialect as d
from nsde_torch.px4.link.connection import Connection, why_no_state

LOOK = 0.05
"""Time between looks at the vehicle [s]."""
STANDS = 1.0
"""Time on the ground after which PX4 is asked to disarm, and between such requests [s]."""


def land(
    link: Connection,
    *,
    options: FlightOptions | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> FlightOutcome:
    """Ask for LAND until that is confirmed, and wait until the vehicle is disarmed, however long that takes.

    No setpoint is sent. Whoever chooses another mode meanwhile has the vehicle; to disarm is asked for on the ground
    alone, and never by force.

    Args:
        link: An open link.
        options: How long is waited for the vehicle, a confirmation, and a silent link.
        say: Takes a line about each step.

    Returns:
        Whether it landed, or what kept it from that; raises nothing.
    """
    options = options or FlightOptions()
    endpoint, out = link.endpoint, FlightOutcome()
    begun = link.now()

    def go(phase: Phase, why: str = "") -> None:
        out.actions.append((link.now() - begun, phase.value, why))
        say(f"{link.now() - begun:7.2f} s  {phase.value}{': ' + why if why else ''}")

    def end(kind: str, why: str) -> FlightOutcome:
        out.trouble = Trouble(kind, why, Action.SILENCE)
        go(Phase.DONE, why)
        return out

    while endpoint.status().heartbeat == -inf:
        if link.now() - begun > options.connect:
            return end(REFUSED, why_no_state(endpoint, options.connect))
        link.pause(LOOK)
    found = endpoint.status()
    if not found.armed:
        return end(REFUSED, "the vehicle is disarmed: nothing is in the air")
    go(Phase.LAND, f"the mode was {found.mode}")
    since, asked, confirmed, stood = link.now(), -inf, False, link.now()
    while (status := endpoint.status()).armed or status.heartbeat < since:
        now = link.now()
        confirmed = confirmed or (status.mode == d.LAND and status.heartbeat >= since)
        if now - status.heard > options.dead:
            return end("link", f"the link is dead: nothing heard for {now - status.heard:.0f} s")
        if confirmed and status.mode != d.LAND:
            return end("mode", f"the mode is {status.mode}: whoever chose it has the vehicle")
        if not confirmed and now - since > options.confirm:
            why = (
                "; ".join(dict.fromkeys(t.text for t in status.texts if t.time >= since))
                or "it gave no reason"
            )
            return end(
                "mode", f"LAND was not confirmed, the mode is {status.mode}: {why}. Land it with the sticks"
            )
        if status.landed != d.ON_GROUND:
            stood = now
        if not confirmed and now - asked > 0.5:
            asked = now
            endpoint.ask_mode(d.LAND)
        elif confirmed and now - max(stood, asked) > STANDS:
            asked = now
            endpoint.command(d.ARM, 0.0)
        link.pause(LOOK)
    out.landed = status.landed != d.IN_AIR
    go(Phase.DONE, "disarmed")
    return out
