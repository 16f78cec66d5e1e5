"""What PX4 does when our stream ends, judged by its parameters before anything is armed.

| parameter | judged |
|---|---|
| COM_OF_LOSS_T | how long it flies on the last rates: refused above 2 s, told where that is more than 2 m of the way |
| COM_OBL_RC_ACT | what it does then: refused where it stops the motors, or hands over to sticks and there are none |
| COM_RC_IN_MODE | whether there are sticks: 4 switches them off |

(Values: PX4 parameter reference.) With COM_OBL_RC_ACT 0 and no sticks a real PX4 was seen to drift at 6.5 m/s into the
ground after its link had been cut.
"""

from __future__ import annotations

from collections.abc import Mapping

OF_LOSS, ACTION, STICKS = "COM_OF_LOSS_T", "COM_OBL_RC_ACT", "COM_RC_IN_MODE"
PARAMETERS = (OF_LOSS, ACTION, STICKS)
LONGEST_LOSS = 2.0
"""Time for which PX4 may hold the last rates when the stream stops [s]."""
BLIND = 2.0
"""Distance that it may fly on the last rates without being told [m]."""
ADVISED_LOSS, ADVISED_ACTION = 0.5, 4
NO_STICKS = 4
_MANUAL = {0: "POSITION", 1: "ALTITUDE", 2: "MANUAL"}
_FALLS = {6: "terminates the flight", 7: "disarms"}
_RETURNS, _HOLDS = 3, 5


def line(name: str, value: float) -> str:
    """The line for PX4's console that sets a parameter."""
    return f"`param set {name} {value:g}`"


def faults(known: Mapping[str, float]) -> list[str]:
    """Reasons not to fly.

    Args:
        known: Parameters of the autopilot, as far as they were answered.
    """
    out = []
    loss, action = known.get(OF_LOSS), known.get(ACTION)
    if loss is not None and not 0.0 < loss <= LONGEST_LOSS:
        out.append(
            f"{OF_LOSS} is {loss:g} s: so long would PX4 fly on stale rates. {line(OF_LOSS, ADVISED_LOSS)} sets it"
        )
    if action in _FALLS:
        out.append(
            f"{ACTION} is {action:g}: when the stream ends PX4 {_FALLS[int(action)]} in the air: the motors stop, and "
            f"it falls. {line(ACTION, ADVISED_ACTION)} makes it land; {_HOLDS} holds, {_RETURNS} returns"
        )
    if action in _MANUAL and known.get(STICKS) == NO_STICKS:
        out.append(
            f"{ACTION} is {action:g}: when the stream ends PX4 goes to {_MANUAL[int(action)]}, which is flown with "
            f"sticks, and {STICKS} is {NO_STICKS}: there are none. {line(ACTION, ADVISED_ACTION)} makes it land"
        )
    return out


def warnings(known: Mapping[str, float], speed: float) -> list[str]:
    """What is not right and does not forbid to fly.

    Args:
        known: Parameters of the autopilot, as far as they were answered.
        speed: Largest speed of the reference [m/s].
    """
    out = []
    loss, action = known.get(OF_LOSS), known.get(ACTION)
    if loss is not None and 0.0 < loss <= LONGEST_LOSS and loss * speed > BLIND:
        out.append(
            f"{OF_LOSS} is {loss:g} s: at {speed:.1f} m/s PX4 flies {loss * speed:.1f} m on stale rates when the "
            f"stream ends. {line(OF_LOSS, ADVISED_LOSS)} makes it less"
        )
    if action in _MANUAL and known.get(STICKS) != NO_STICKS:
        out.append(
            f"{ACTION} is {action:g}: when the stream ends PX4 goes to {_MANUAL[int(action)]}, and without a pilot at "
            f"the sticks drifts into the ground. {line(ACTION, ADVISED_ACTION)} makes it land"
        )
    if action == _RETURNS:
        out.append(
            f"{ACTION} is {action:g}: when the stream ends PX4 climbs to RTL_RETURN_ALT first. "
            f"{line(ACTION, ADVISED_ACTION)} makes it land"
        )
    return out
