"""How a flight over MAVLink ended, and whether its vehicle may be flown again without somebody having looked."""

from __future__ import annotations

from nsde_torch.px4.flight.phases import REFUSED, FlightOutcome
from nsde_torch.px4.link.transport import LinkError

from .exit_status import FLIGHT_ENDED, INTERRUPTED, NOT_LANDED, EndedError

_STOPPED = ("stop", "stopped")
_TAKEN = ("mode", "setpoints", "disarmed", "link", "late")
"""Troubles after which the vehicle was the operator's or PX4's, and not ours."""


def check_end(outcome: FlightOutcome) -> None:
    """Pass a flight that was flown by us alone and is seen to stand, whatever limit it may have tripped.

    Raises:
        LinkError: it was refused before it began.
        EndedError: it was not seen to land, was stopped, or the vehicle was taken from us.
    """
    trouble = outcome.trouble
    if trouble is not None and trouble.kind == REFUSED:
        raise LinkError(trouble.text)
    why = "the reference was not flown to its end" if trouble is None else trouble.text
    stopped = trouble is not None and trouble.kind in _STOPPED
    if stopped and not outcome.begun:
        raise EndedError(f"the flight was stopped before it began: {why}", INTERRUPTED)
    if not outcome.landed:
        raise EndedError(f"the vehicle was NOT seen to land: {why}", NOT_LANDED)
    if stopped:
        raise EndedError(f"the flight was stopped, and landed: {why}", INTERRUPTED)
    if trouble is not None and trouble.kind in _TAKEN:
        raise EndedError(f"the flight went wrong, and landed: {why}", FLIGHT_ENDED)
