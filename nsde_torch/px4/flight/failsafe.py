"""What PX4 does when something is lost, judged by its parameters before anything is armed.

| parameter | judged |
|---|---|
| COM_OF_LOSS_T | how long it flies on the last rates: refused above 2 s, noted where that is more than 2 m of way |
| COM_OBL_RC_ACT, NAV_RCL_ACT, NAV_DLL_ACT, GF_ACTION | refused where it stops the motors in the air |
| these, COM_LOW_BAT_ACT, RTL_RETURN_ALT | noted where it climbs above the fence's top to return |
| COM_LOW_BAT_ACT | noted where it only warns |
| COM_RC_IN_MODE | whether there are sticks: 4 switches them off; refused where COM_OBL_RC_ACT hands over to them |
| COM_RCL_EXCEPT, COM_DLL_EXCEPT | whether a lost transmitter or ground station matters in OFFBOARD |
| COM_RC_OVERRIDE | noted where moving the sticks does not end OFFBOARD |
| GF_MAX_HOR_DIST, GF_MAX_VER_DIST | noted where PX4's own fence is nearer than ours |
| SENS_GPS0_DELAY, in older versions EKF2_GPS_DELAY | noted below 5 ms: no receiver is that fresh |
| SDLOG_PROFILE | noted where PX4's own log has the motors at 10 Hz |

(Values: PX4 parameter reference.) With COM_OBL_RC_ACT 0 and no sticks a real PX4 was seen to drift at 6.5 m/s into the
ground after its link had been cut.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import ceil, inf
from typing import NamedTuple

OF_LOSS, ACTION, STICKS = "COM_OF_LOSS_T", "COM_OBL_RC_ACT", "COM_RC_IN_MODE"
CLIMBS_TO, BATTERY = "RTL_RETURN_ALT", "COM_LOW_BAT_ACT"
OVERRIDE, PROFILE = "COM_RC_OVERRIDE", "SDLOG_PROFILE"
LONGEST_LOSS = 2.0  # time for which PX4 may hold the last rates when the stream stops [s]
BLIND = 2.0  # distance that it may fly on the last rates without a remark [m]
ADVISED_LOSS, ADVISED_ACTION, ADVISED_PROFILE = 0.5, 4, 147
NO_STICKS = 4
IN_OFFBOARD, OVER_OFFBOARD, HIGH_RATE = 4, 2, 16
"""Bits: of the exceptions, of COM_RC_OVERRIDE and of SDLOG_PROFILE."""
_MANUAL = {0: "POSITION", 1: "ALTITUDE", 2: "MANUAL"}
_ENDS, _DISARMS = "terminates the flight", "disarms"


class _Failsafe(NamedTuple):
    """What a parameter says that PX4 does, by its values; `excepted` names the parameter that may say otherwise."""

    name: str
    when: str
    lands: int
    returns: tuple[int, ...]
    falls: Mapping[int, str]
    excepted: str = ""


_FAILSAFES = (
    _Failsafe(ACTION, "the stream ends", ADVISED_ACTION, (3,), {6: _ENDS, 7: _DISARMS}),
    _Failsafe("NAV_RCL_ACT", "the transmitter is lost", 3, (2,), {5: _ENDS, 6: _DISARMS}, "COM_RCL_EXCEPT"),
    _Failsafe(
        "NAV_DLL_ACT", "the ground station is lost", 3, (2,), {5: _ENDS, 6: _DISARMS}, "COM_DLL_EXCEPT"
    ),
    _Failsafe("GF_ACTION", "its own fence is left", 5, (3,), {4: _ENDS}),
    _Failsafe(BATTERY, "the battery is low", 2, (1, 3), {}),
)
GPS_DELAYS, FRESHEST = ("SENS_GPS0_DELAY", "EKF2_GPS_DELAY"), 5.0
"""Age that PX4 takes a position fix for, by its newer and older name, and the shortest that is accepted [ms]."""
OWN_FENCE = ("GF_MAX_HOR_DIST", "GF_MAX_VER_DIST")
OPTIONAL = ("COM_DLL_EXCEPT", *GPS_DELAYS)  # parameters that some versions of PX4 do not have
PARAMETERS = (
    *(OF_LOSS, *(one.name for one in _FAILSAFES), "COM_RCL_EXCEPT", STICKS),
    *(*OWN_FENCE, CLIMBS_TO, OVERRIDE, PROFILE),
)


def line(name: str, value: float) -> str:
    """The line for PX4's console that sets a parameter."""
    return f"`param set {name} {value:g}`"


def faults(known: Mapping[str, float]) -> list[str]:
    """Reasons not to fly, by the autopilot's parameters as far as they were answered."""
    out = []
    loss, action = known.get(OF_LOSS), known.get(ACTION)
    if loss is not None and not 0.0 < loss <= LONGEST_LOSS:
        out.append(
            f"{OF_LOSS} is {loss:g} s: so long would PX4 fly on stale rates. {line(OF_LOSS, ADVISED_LOSS)} sets it"
        )
    for one, value in _heeded(known):
        if value in one.falls:
            out.append(
                f"{one.name} is {value:g}: when {one.when} PX4 {one.falls[int(value)]} in the air: the motors stop, "
                f"and it falls. {line(one.name, one.lands)} makes it land"
            )
    if action in _MANUAL and known.get(STICKS) == NO_STICKS:
        out.append(
            f"{ACTION} is {action:g}: when the stream ends PX4 goes to {_MANUAL[int(action)]}, which is flown with "
            f"sticks, and {STICKS} is {NO_STICKS}: there are none. {line(ACTION, ADVISED_ACTION)} makes it land"
        )
    return out


def warnings(
    known: Mapping[str, float],
    speed: float,
    *,
    top: float = inf,
    reach: float = inf,
    receiver: bool | None = None,
) -> list[str]:
    """What is not right and does not forbid to fly, by the autopilot's parameters as far as they were answered.

    `speed` is the largest of the reference [m/s], `top` and `reach` are the height of the fence's top and the
    horizontal distance of its farthest corner from the place of take-off [m]; `receiver`: whether a transmitter is
    heard, None: not known.
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
    climbs = known.get(CLIMBS_TO)
    for one, value in _heeded(known):
        if value in one.returns and (climbs is None or climbs > top):
            to = CLIMBS_TO if climbs is None else f"{CLIMBS_TO}, {climbs:g} m,"
            out.append(
                f"{one.name} is {value:g}: when {one.when} PX4 returns, and climbs to {to} first; the fence ends at "
                f"{top:g} m. {line(one.name, one.lands)} makes it land"
            )
    for name, ours in zip(OWN_FENCE, (reach, top), strict=True):
        if 0.0 < known.get(name, 0.0) < ours < inf:
            out.append(
                f"{name} is {known[name]:g} m, and our fence reaches to {ours:.3g} m: PX4 acts on its own fence first "
                f"(GF_ACTION). {line(name, ceil(ours))} lets ours act first"
            )
    for name in GPS_DELAYS:
        if known.get(name, inf) < FRESHEST:
            out.append(
                f"{name} is {known[name]:g} ms: no receiver is that fresh, and a wrong age sets the estimated position "
                f"apart from the attitude. {line(name, 110)} is PX4's default"
            )
    if known.get(BATTERY) == 0:
        out.append(
            f"{BATTERY} is 0: PX4 only warns of a low battery, and nothing lands it where this program is gone. "
            f"{line(BATTERY, 2)} makes it land"
        )
    override = known.get(OVERRIDE)
    if known.get(STICKS) != NO_STICKS:
        if override is not None and not int(override) & OVER_OFFBOARD:
            out.append(
                f"{OVERRIDE} is {override:g}: to move the sticks does not end OFFBOARD, only the mode switch does. "
                f"{line(OVERRIDE, int(override) | OVER_OFFBOARD)} makes both do"
            )
        if receiver is False:
            out.append("no transmitter is heard: no pilot can take over. Switch it on")
    profile = known.get(PROFILE)
    if profile is not None and not int(profile) & HIGH_RATE:
        out.append(
            f"{PROFILE} is {profile:g}: PX4's own log has its motors at 10 Hz, too slow for a diagnosis. "
            f"{line(PROFILE, ADVISED_PROFILE)} and a restart log them fast"
        )
    return out


def _heeded(known: Mapping[str, float]) -> list[tuple[_Failsafe, float]]:
    """The failsafes that act in OFFBOARD, with their values."""
    out = []
    for one in _FAILSAFES:
        excepted = int(known.get(one.excepted, 0)) & IN_OFFBOARD
        if one.excepted == "COM_RCL_EXCEPT":
            excepted = excepted or known.get(STICKS) == NO_STICKS
        if one.name in known and not excepted:
            out.append((one, known[one.name]))
    return out
