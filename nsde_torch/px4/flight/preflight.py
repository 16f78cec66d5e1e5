"""What must be right before anything is armed; each fault with its reason and remedy."""

from collections.abc import Mapping
from math import ceil, hypot, inf, isfinite
from typing import NamedTuple

from nsde_torch.px4.flight.cascade import PathPoints
from nsde_torch.px4.flight.safety import MARGIN, Limits, contradicted
from nsde_torch.px4.link import dialect as d
from nsde_torch.px4.link.endpoint import Endpoint
from nsde_torch.px4.link.telemetry import Status, VehicleState
from nsde_torch.px4.link.vectors import length, tilt_of
from nsde_torch.px4.options import FlightOptions

FEWEST = 70.0  # states in a second with which a flight may begin; more are asked for, and some get lost
CLIMB_TIME = 0.55
"""How far a climb rises past its end, as a time at its speed [s]; simulated: 0.2 m at 0.8 m/s, 0.6 at 1.5, 1.5 at 3."""
ROUNDED = 1e-3  # what is said of heights is rounded to this, and what follows it is not refused [m]
SETTLED = 0.5
"""Share of `limits.innovation` above which a flight does not begin; PX4 arms up to ratios of 0.5 (COM_ARM_EKF_*)."""
MOVES = 0.5  # speed from which on a vehicle does not stand [m/s]; an estimate that settles is slower
_LANDED = {
    d.ON_GROUND: "says that it is on the ground, but moves",
    d.IN_AIR: "says that it is in the air",
    d.TAKING_OFF: "says that it takes off",
    d.LANDING: "says that it is landing",
}
"""What EXTENDED_SYS_STATE says of a vehicle that may be flying."""


def faults(
    endpoint: Endpoint,
    status: Status,
    state: VehicleState | None,
    path: PathPoints,
    limits: Limits,
    *,
    options: FlightOptions,
    now: float,
) -> list[str]:
    """Reasons not to fly a path from the place of take-off, at a time of our clock [s]; empty: none."""
    out = []
    if state is None:
        return ["no state: neither ODOMETRY nor ATTITUDE_QUATERNION with LOCAL_POSITION_NED"]
    age, late, rate = now - state.time, endpoint.telemetry.sync.late, endpoint.telemetry.rate
    if age > limits.estimate:
        out.append(f"the newest state is {age:.2f} s old")
    # the age of states is then a guess from below, and a late line looks like a quick one
    if late is not None:
        out.append(f"TIMESYNC is answered after {late:.1f} s: a faster link is needed")
    if rate < FEWEST:
        out.append(f"states come at {rate:.0f} Hz, less than {FEWEST:.0f}: a faster link is needed")
    out += _not_to_take_over(status, state, limits) if options.takeover else _not_at_rest(status, state)
    if tilt_of(state.q) > 12.0:
        out.append(f"it stands tilted by {tilt_of(state.q):.0f} deg")
    if length(state.v) > MOVES or length(state.w) > 0.5:
        out.append(f"it moves: {length(state.v):.1f} m/s, {length(state.w):.1f} rad/s")
    if isfinite(status.remaining) and status.remaining < limits.battery + 0.1:
        out.append(f"battery at {100 * status.remaining:.0f} %: charge it")
    if limits.voltage > 0 and isfinite(status.voltage) and status.voltage < limits.voltage:
        out.append(f"battery at {status.voltage:.1f} V: charge it")
    if against := contradicted(status.quality, limits, now, part=SETTLED):
        out.append(f"{against}: wait until it has settled, with a clear view of the sky")
    out += failsafe_faults(status.parameters)
    out += _outside(path, limits, options)
    return out


def _not_at_rest(status: Status, state: VehicleState) -> list[str]:
    """Armed or in the air; only what says that it stands, and does not move, may be disarmed by hand."""
    stands = status.landed == d.ON_GROUND and length(state.v) <= MOVES
    if status.armed and stands:
        return ["the vehicle is armed already, on the ground: disarm it"]
    where = _LANDED.get(status.landed, "does not say whether it is on the ground")
    if status.armed:
        return [
            f"the vehicle is armed already and {where}: it may be flying, so do not disarm it. Take it over with the "
            "sticks, land it (nsde land), or fly it from HOLD (takeover=true)"
        ]
    if status.landed in _LANDED and status.landed != d.ON_GROUND:
        return [f"the vehicle is disarmed and {where}: wait until it says that it is on the ground"]
    return []


def _not_to_take_over(status: Status, state: VehicleState, limits: Limits) -> list[str]:
    """Why a vehicle may not be taken over: it must fly, belong to nobody, and be inside the fence."""
    if not status.armed or status.landed == d.ON_GROUND:
        return ["takeover=true is for a vehicle in the air, and this one is not: fly without it"]
    out = []
    if status.mode != d.HOLD:
        out.append(
            f"the mode is {status.mode}, in which somebody may fly it: choose HOLD, or land it (nsde land)"
        )
    if status.home is None:
        out.append(
            "PX4 does not tell where it took off (HOME_POSITION), and fence and reference count from there: land it "
            "(nsde land)"
        )
    elif limits.outside(state.p, status.home):
        out.append("it is outside the fence: a larger one (limits.fence), or land it (nsde land)")
    return out


def climb_room(options: FlightOptions) -> float:
    """Height below the fence's top at which a climb must end, because it rises past its end [m]."""
    return max(CLIMB_TIME * options.climb, MARGIN)


def _outside(path: PathPoints, limits: Limits, options: FlightOptions) -> list[str]:
    out = []
    for axis, low, high, (from_, to) in zip("xyz", path.low, path.high, limits.fence, strict=True):
        if low < from_ or high > to:
            out.append(
                f"the reference leaves the fence: {axis} from {low:.1f} to {high:.1f} m, fence {from_:g} to {to:g}"
            )
    floor, top = limits.fence[2]
    high, room = path.high[2], climb_room(options)
    if top - MARGIN + ROUNDED < high <= top:
        out.append(
            f"the reference goes up to {high:.4g} m, and the fence's top is at {top:g} m: no flight is that exact. "
            f"Keep {MARGIN:g} m: a reference up to {top - MARGIN:.4g} m, or a fence (limits.fence) up to "
            f"{high + MARGIN:.4g} m"
        )
    if options.takeover:
        return out
    if options.height < floor:
        out.append(f"the height of take-off, {options.height:g} m, is below the fence")
    if options.height > top - room + ROUNDED:
        out.append(
            f"the height of take-off is {options.height:g} m, and the fence's top is at {top:g} m: a climb at "
            f"{options.climb:g} m/s rises past its end. Keep {room:.2g} m: a take-off (height) to {top - room:.4g} m "
            f"at most, a slower climb, or a fence (limits.fence) up to {options.height + room:.4g} m"
        )
    return out


def warnings(endpoint: Endpoint, status: Status, path: PathPoints, limits: Limits) -> list[str]:
    """What is not right and does not forbid to fly."""
    out = [f"{name} was not answered" for name in PARAMETERS if name not in status.parameters]
    top = limits.fence[2][1]
    reach = hypot(*(max(-low, high) for low, high in limits.fence[:2]))
    out += failsafe_warnings(status.parameters, path.speed, top=top, reach=reach, receiver=status.receiver)
    if not isfinite(status.remaining):
        out.append("the battery's charge is unknown: nothing will end the flight when it is empty")
    if endpoint.telemetry.sync.round_trip is None:
        out.append("TIMESYNC is not answered: the age of states is a guess from below")
    if status.quality is None:
        out.append("ESTIMATOR_STATUS is not sent: an estimate that its sensors contradict goes unnoticed")
    if not status.motors:
        out.append("the motors' commands are not sent: the log has no inputs")
    return out


# What PX4 does when something is lost, judged by its parameters before anything is armed (values: PX4 parameter
# reference). With COM_OBL_RC_ACT 0 and no sticks a real PX4 was seen to drift at 6.5 m/s into the ground after its link
# had been cut.

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
    "MPC_THR_HOVER",
    *(OF_LOSS, *(one.name for one in _FAILSAFES), "COM_RCL_EXCEPT", STICKS),
    *(*OWN_FENCE, CLIMBS_TO, OVERRIDE, PROFILE),
)  # that are asked for


def line(name: str, value: float) -> str:
    """The line for PX4's console that sets a parameter."""
    return f"`param set {name} {value:g}`"


def failsafe_faults(known: Mapping[str, float]) -> list[str]:
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


def failsafe_warnings(
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
